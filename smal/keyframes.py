"""Selection of keyframes, and the parameters of a map."""

import math
from dataclasses import dataclass, fields
from typing import Any, Final

import numpy as np

from smal.arrays import Bools, Floats, Int32s
from smal.movement import wrapped

#: Maximum of the shares: the tail keeps some views, and a place is visible in half of its views.
_MOST_SHARES: Final = {"usual": 0.999, "hidden": 0.5}


@dataclass(frozen=True)
class MapConfig:
    """Parameters of a map, stored in the model. Lengths are in correlation lengths."""

    #: Keyframes in a correlation length: between two of them a view hardly changes.
    views_a_length: int = 5
    #: Turn between two keyframes. A robot is then turned by about one virtual view from the nearest keyframe.
    spacing_deg: float = 12.0
    #: Way over which odometry is accurate enough to detect a return to the same place.
    mended: float = 4.0
    #: Components of variance v are divided by v to this power; 0.5 gives all components equal weight. The largest
    #: components are common to many places (sky, light), the smallest are noise.
    whitened: float = 0.25
    #: The map of 1 km at 2 m/s then takes 0.2 GB.
    most_components: int = 400
    #: Views from which components are computed; limits memory.
    sampled_views: int = 2500
    #: Places of a drive that are further apart are different. A robot further from its keyframe is lost.
    elsewhere: float = 4.0
    #: Number of views in the sample of elsewhere.
    reference: int = 256
    #: Share of views elsewhere with an empirical distribution; the rest has an exponential tail.
    usual: float = 0.95
    #: Share of views in which something hides the place.
    hidden: float = 0.1
    #: Number of keyframes that a view is compared with in a global search.
    looked_at: int = 500
    #: Leading components that select these keyframes on long ways.
    leading: int = 64
    #: Maximum view variants of a keyframe, the taught view included. More cost memory and time, and can be wrong.
    most_variants: int = 4
    #: Keyframes that a drive can advance while another advances by one: drives stop, and turn elsewhere.
    advance: int = 3
    #: Standard deviations of odometry that are accepted.
    trusted: float = 3.0
    #: Turn rate of a robot that never turned in its drives.
    usual_turn_deg_s: float = 45.0

    def __post_init__(self) -> None:
        """Raise ValueError if a parameter is out of range: parameters can come from a file."""
        for part in fields(self):
            number = getattr(self, part.name)
            usual: Any = part.default
            most = _MOST_SHARES.get(part.name, 100 * usual)
            if type(number) is not type(usual) or not 0 < number <= most:
                raise ValueError(
                    f"{part.name} must be above 0, at most {most:g}, got {number!r:.40}"
                )
        if self.looked_at < self.views_a_length:
            raise ValueError(
                f"looked_at must be at least views_a_length, {self.views_a_length}, "
                f"got {self.looked_at}"
            )

    @property
    def aside(self) -> float:
        """Distance of virtual views to the side: two keyframe spacings."""
        return 2.0 / self.views_a_length

    @property
    def neighbours(self) -> int:
        """Keyframes to both sides among which a moved particle finds its nearest."""
        return self.views_a_length + 1


MAP_CONFIG: Final = MapConfig()


def shows_same(
    poses: Floats,
    pose: Floats,
    length: float,
    config: MapConfig = MAP_CONFIG,
) -> Bools:
    """Return at which poses (f, 3) the view is nearly the same as at a pose (3,), for a correlation length."""
    moved = poses - pose
    near = np.hypot(*moved[:, :2].T) < length / config.views_a_length
    turned = np.abs(wrapped(moved[:, 2]))
    return np.asarray(near & (turned < math.radians(config.spacing_deg)))


def without_detours(
    poses: Floats,
    drives: Int32s,
    length: float,
    config: MapConfig = MAP_CONFIG,
) -> Bools:
    """Return the frames (f,) on the way to the goal, without detours.

    Frames between two equal views are a detour: a wrong turn and its correction, or a way there and back. If the
    second pose is further from the first than half of the way between, the frames are kept.
    """
    # Standing frames are skipped: the time grows with the square of the compared frames.
    moves = np.diff(poses, axis=0).any(axis=1)
    moved = np.append(True, moves | (np.diff(drives) != 0))
    poses = poses[moved]
    drives = drives[moved]
    steps = np.hypot(*np.diff(poses[:, :2], axis=0).T)
    way = np.append(0.0, np.cumsum(steps))
    on = np.zeros(len(poses), dtype=np.bool_)
    frame = 0
    while frame < len(poses):
        on[frame] = True
        end_of_drive = np.searchsorted(drives, drives[frame], "right")
        reach = np.searchsorted(way, way[frame] + config.mended * length, "right")
        end = min(end_of_drive, reach)
        later = poses[frame + 1 : end]
        since = way[frame + 1 : end] - way[frame]
        apart = np.hypot(*(later - poses[frame])[:, :2].T)
        # A robot that turns on the spot creeps ahead a little.
        returned = apart < np.maximum(since, 0.1 * length) / 2.0
        back = shows_same(later, poses[frame], length, config) & returned
        last = int(np.flatnonzero(back).max(initial=-1))
        frame += 1 if back[: last + 1].all() else last + 1
    return np.asarray(on[np.cumsum(moved) - 1])

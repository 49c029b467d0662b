"""Which taught frames become keyframes, and the numbers that shape a map."""

import math
from dataclasses import dataclass, fields
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from smal.movement import wrapped


@dataclass(frozen=True)
class MapConfig:
    """Numbers that shape a map; a model keeps them. Lengths are in correlation lengths."""

    #: Keyframes in a correlation length: between two of them a view hardly changes, and one further it is new.
    views_a_length: int = 5
    #: A turn makes a keyframe, too: a robot is then turned by about one virtual view from the nearest one.
    spacing_deg: float = 12.0
    #: Way over which wheels show whether a person came back to where they were, and mended what they did.
    mended: float = 4.0
    #: Components of variance v are divided by v to this power: half way to where all count alike. The largest ones are
    #: what many places share (sky, light), the smallest are noise.
    whitened: float = 0.25
    most_components: int = 400  # The map of 1 km at 2 m/s then takes 0.2 GB.
    sampled_views: int = 2500  # Views from which components are computed: memory.
    #: Two places of a drive that are further apart are different ones; further from its keyframe, a robot is lost.
    elsewhere: float = 4.0
    reference: int = 256  # Views that are the sample of elsewhere.
    #: Share of views elsewhere whose distribution is taken as it is; that of the rest is an exponential tail.
    usual: float = 0.95
    #: Share of views that show nothing of the place, since something hides it.
    hidden: float = 0.1
    #: Keyframes at which a view is looked for anywhere, and leading components by which they are chosen on longer ways.
    looked_at: int = 500
    leading: int = 64
    #: Looks of a keyframe at most, the taught one among them: more cost memory and time, and each can be mistaken.
    looks: int = 4
    #: Keyframes that one drive may go on by while another goes on by one: drives stop, and turn elsewhere.
    advance: int = 3
    trusted: float = 3.0  # Standard deviations of odometry that are believed.
    usual_turn_deg_s: float = (
        45.0  # How fast robots turn, where no drive turns and nothing else tells.
    )

    def __post_init__(self) -> None:
        """ValueError where a number cannot shape a map: it may come from a file."""
        for part in fields(self):
            number = getattr(self, part.name)
            usual: Any = part.default
            most = 100 * usual
            if type(number) is not type(usual) or not 0 < number <= most:
                raise ValueError(
                    f"{part.name} must be above 0, at most {most:g}, got {number!r:.40}"
                )

    @property
    def aside(self) -> float:
        """How far aside virtual views are taken: two steps from keyframe to keyframe."""
        return 2.0 / self.views_a_length

    @property
    def neighbours(self) -> int:
        """Keyframes to both sides among which a particle that moved finds its nearest."""
        return self.views_a_length + 1


MAP_CONFIG: Final = MapConfig()


def shows_same(
    poses: NDArray[np.float64],
    pose: NDArray[np.float64],
    length: float,
    config: MapConfig = MAP_CONFIG,
) -> NDArray[np.bool_]:
    """Tell where a view is hardly another one than at a pose (3,): poses (f, 3), length that of correlation."""
    moved = poses - pose
    near = np.hypot(*moved[:, :2].T) < length / config.views_a_length
    return np.asarray(near & (np.abs(wrapped(moved[:, 2])) < math.radians(config.spacing_deg)))


def leads_on(
    poses: NDArray[np.float64],
    drives: NDArray[np.int32],
    length: float,
    config: MapConfig = MAP_CONFIG,
) -> NDArray[np.bool_]:
    """Tell which frames a robot is to pass, (f,).

    Frames between two that show the same led nowhere: a wrong turn and its correction, or a way there and back. They
    are kept where the second of the two is further from the first than half of the way between: it leads on.
    """
    # However long it stands: the time to tell grows with the square of the frames that are compared.
    moved = np.append(True, np.diff(poses, axis=0).any(axis=1) | (np.diff(drives) != 0))
    poses = poses[moved]
    drives = drives[moved]
    way = np.append(0.0, np.cumsum(np.hypot(*np.diff(poses[:, :2], axis=0).T)))
    on = np.zeros(len(poses), dtype=np.bool_)
    frame = 0
    while frame < len(poses):
        on[frame] = True
        end = np.searchsorted(drives, drives[frame], "right")
        end = min(end, np.searchsorted(way, way[frame] + config.mended * length, "right"))
        later = poses[frame + 1 : end]
        since = way[frame + 1 : end] - way[frame]
        apart = np.hypot(*(later - poses[frame])[:, :2].T)
        # Who turns on the spot creeps ahead a little.
        back = shows_same(later, poses[frame], length, config) & (
            apart < np.maximum(since, 0.1 * length) / 2.0
        )
        last = int(np.flatnonzero(back).max(initial=-1))
        frame += 1 if back[: last + 1].all() else last + 1
    return np.asarray(on[np.cumsum(moved) - 1])

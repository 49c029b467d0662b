"""Baseline of teach and repeat: odometry gives the place along one drive, images correct it and the heading.

D. Dall'Osto, T. Fischer, M. Milford, "Fast and Robust Bio-inspired Teach and Repeat Navigation", IROS 2021 (github
QVPR/teach-repeat), after T. Krajnik et al., "Navigation without localization: reliable teach and repeat based on the
convergence theorem", IROS 2018: odometry replays the drive, and correcting only the heading by the horizontal shift
of the image bounds the error across the way. Numbers without another reason are the authors' for their Jackal, with a
camera of 75 degrees too. Departures:

- Distances are in forward atoms, so that one set of numbers works indoors and outdoors.
- The speeds of their controller become atoms: a turn on the spot if the goal is off by more than one turning atom. Half
  of that takes one and a half times as long for the same error, because each turn costs the robot its speed.
- A run can start beside any keyframe of any drive, and turned (theirs at any keyframe, but on the way). Therefore the
  heading by the best keyframe counts in full at the start, and first keyframes have an advantage. A robot that
  recognises nothing looks around once, where theirs refuses to start.
"""

import math
from collections.abc import Sequence
from typing import Final, NamedTuple, TypeVar

import numpy as np

from smal.arrays import Float32s, Floats, Uint8s
from smal.evaluation.driver import Depth, PlaceEstimate
from smal.evaluation.image_shift import padded, prepared, turn_to
from smal.movement import MOTIONS, Atom, Motion, placed, seen_from
from smal.planning import Said
from smal.teaching.demonstration import Demonstration
from smal.teaching.movements import atom_movements

_T = TypeVar("_T")
#: Distance between keyframes: theirs are 0.2 m apart, 0.5 s of a slow indoor robot.
SPACING_ATOMS: Final = 5.0
#: Turn between keyframes, and heading error of a reached goal.
TURNED_RAD: Final = math.radians(15.0)
#: Lookahead, and distance within which a goal is a mere turn; in spacings.
LOOKAHEAD = 1.3
TURNING = 0.2
#: Keyframes before and after the current two that are compared.
SEARCH: Final = 3
#: Correlation below which a keyframe gives no evidence.
RECOGNIZED: Final = 0.1
#: Fraction by which one image corrects the heading (theirs for the MiRo; 0.01 leaves three times the error) and the way
#: along (theirs; with 0.05 fewer searches succeed).
TURN_GAIN = 0.1
WAY_GAIN = 0.01
#: Advantage in correlation of first keyframes, and minimum of the best to start without looking around. Both were
#: chosen on the first frames of 36 drives in four simulated worlds, to detect starts near the first keyframe.
FIRST = 0.1
SURE = 0.3


class _Route(NamedTuple):
    """Frames, counted over all drives, poses (k, 3) and padded images of the keyframes of one drive."""

    frames: list[int]
    poses: Floats
    images: list[Float32s]


class TeachAndRepeat:
    """Repeats the drive with the keyframe that correlates best with the first image.

    Parameters
    ----------
    drives : sequence of Demonstration
        Drives with images and odometry.
    field_of_view_rad : float
        Horizontal field of view of the camera, above 0 and below pi.
    told : bool
        Whether the robot starts where a drive started.

    Raises
    ------
    ValueError
        If a drive lacks images or odometry, or the drives have no turn or no way ahead.
    """

    def __init__(
        self, drives: Sequence[Demonstration], field_of_view_rad: float, *, told: bool = False
    ) -> None:
        self._field = field_of_view_rad
        self._told = told
        images = [_kept(drive.images, drive.name) for drive in drives]
        ways = [_kept(drive.odometry, drive.name) for drive in drives]
        movements = atom_movements(ways, [drive.atoms for drive in drives])
        self._turn = abs(float(movements[Atom.LEFT, 1]))
        self._spacing = SPACING_ATOMS * float(movements[Atom.FORWARD, 0])
        if not (self._turn > 0.0 and self._spacing > 0.0):
            raise ValueError("the drives must show at least one turn and one way ahead")
        firsts = np.cumsum([0, *map(len, ways[:-1])]).tolist()
        self._routes = [
            self._route_of(*taught) for taught in zip(images, ways, firsts, strict=True)
        ]
        self.reset()

    def reset(self, seed: int = 0) -> None:
        """Start a new episode; the method has no random numbers."""
        del seed
        self._route: _Route | None = None
        self._index = 0
        self._looked_rad = 0.0
        self._looking = False
        self._heading = math.nan
        #: Correlation, route, keyframe and pose of the best match.
        self._best = (-math.inf, 0, 0, (0.0, 0.0, 0.0))

    @property
    def said(self) -> Said | None:
        """Announced result: "found" at the end of the drive."""
        ended = self._route is not None and self._index >= len(self._route.poses)
        return "found" if ended else None

    @property
    def place(self) -> PlaceEstimate | None:
        """Taught frame in the middle between the last goal and the next; None while the robot looks around."""
        if self._route is None:
            return None
        frames = self._route.frames
        return PlaceEstimate(
            (frames[self._index - 1] + frames[min(self._index, len(frames) - 1)]) // 2
        )

    def step(
        self,
        image: Uint8s,
        odometry: Sequence[float],
        depth: Depth | None = None,
        elapsed_s: float | None = None,
    ) -> Motion:
        """Return the velocity until the next image; see `Driver.step`."""
        del depth, elapsed_s
        return MOTIONS[self._atom(image, odometry)]

    def _atom(self, image: Uint8s, odometry: Sequence[float]) -> Atom:
        """Return the next atom."""
        here = np.asarray(odometry, dtype=np.float64)
        seen = prepared(image)
        route = self._route or self._begin(seen, here)
        if route is None:
            return Atom.LEFT
        if 0 < self._index < len(route.poses) and not self._is_turn(route):
            self._correct(route, seen, here)
        while self._index < len(route.poses):
            # The last goal, and mere turns, have no lookahead.
            turning = self._is_turn(route)
            last = self._index == len(route.poses) - 1
            ahead = 0.0 if turning or last else LOOKAHEAD * self._spacing
            x, y, heading = seen_from(placed(np.array([ahead, 0.0, 0.0]), self._goal), here)
            distance = math.hypot(x, y)
            if distance >= LOOKAHEAD * self._spacing or abs(heading) >= TURNED_RAD:
                arrived = distance < (LOOKAHEAD if turning else TURNING) * self._spacing
                off = heading if arrived else math.atan2(y, x)
                return self._towards(off)
            self._advance(route)
        return Atom.STOP

    def _towards(self, off_rad: float) -> Atom:
        """Return the atom for a direction, from the heading to the left."""
        if abs(off_rad) <= self._turn:
            return Atom.FORWARD
        return Atom.LEFT if off_rad > 0.0 else Atom.RIGHT

    def _route_of(self, images: Sequence[Uint8s], odometry: Floats, first: int) -> _Route:
        """Select the first frame, the last, and one after each spacing or turn."""
        keys = [0]
        for frame, pose in enumerate(odometry):
            x, y, heading = seen_from(pose, odometry[keys[-1]])
            far = math.hypot(x, y) > self._spacing or abs(heading) > TURNED_RAD
            if far or frame == len(odometry) - 1:
                keys.append(frame)
        frames = [first + key for key in keys]
        return _Route(frames, odometry[keys], [padded(prepared(images[key])) for key in keys])

    def _begin(self, seen: Float32s, here: Floats) -> _Route | None:
        """Find the place of the robot; None while it must turn left to look around."""
        for number, route in enumerate(self._routes):
            for key, taught in enumerate(route.images[: 1 if self._told else -1]):
                off, correlation = turn_to(taught, seen, self._field)
                place = (float(here[0]), float(here[1]), float(here[2]) + off)
                self._best = max(self._best, (correlation + FIRST * (key == 0), number, key, place))
        if not math.isnan(self._heading):
            self._looked_rad += math.remainder(float(here[2]) - self._heading, math.tau)
        self._heading = float(here[2])
        self._looking |= self._best[0] < SURE and not self._told
        if self._looking and self._looked_rad < math.tau:
            return None
        _, number, self._index, place = self._best
        self._route = self._routes[number]
        self._goal = np.array(place)
        self._advance(self._route)
        return self._route

    def _is_turn(self, route: _Route) -> bool:
        """Return whether the goal is at the last goal, turned."""
        x, y, _ = seen_from(route.poses[self._index], route.poses[self._index - 1])
        return math.hypot(x, y) < TURNING * self._spacing

    def _advance(self, route: _Route) -> None:
        """Make the next keyframe the goal, at the taught distance from the last."""
        self._last = self._goal
        self._index = self._index + 1
        if self._index < len(route.poses):
            leg = seen_from(route.poses[self._index], route.poses[self._index - 1])
            self._goal = placed(leg, self._last)

    def _correct(self, route: _Route, seen: Float32s, here: Floats) -> None:
        """Turn the goal about the robot, and move it nearer or further, by the correlations with nearby keyframes."""
        reach = min(SEARCH, self._index - 1, len(route.poses) - 1 - self._index)
        nearby = route.images[self._index - 1 - reach : self._index + reach + 1]
        offs, correlations = np.array([turn_to(taught, seen, self._field) for taught in nearby]).T
        # Fraction of the way from the last goal to this goal behind the robot, by odometry and by images.
        leg = seen_from(self._goal, self._last)[:2]
        driven = seen_from(here, self._last)[:2]
        done = float(leg @ driven) / max(float(leg @ leg), np.finfo(float).tiny)
        turn = 0.0
        if 0.0 <= done <= 1.0 and correlations[reach : reach + 2].max() >= RECOGNIZED:
            turn = TURN_GAIN * float((1.0 - done) * offs[reach] + done * offs[reach + 1])
        weights = np.maximum(correlations - RECOGNIZED, 0.0)
        nearer = 0.0
        if weights.any():
            looks = float(weights @ np.arange(-reach, reach + 2)) / float(weights.sum())
            nearer = WAY_GAIN * (looks - done) * self._spacing
        goal = seen_from(self._goal, here)
        distance = math.hypot(goal[0], goal[1])
        if nearer >= distance:
            self._advance(route)
            return
        goal[:2] *= 1.0 - nearer / distance
        self._goal = placed(goal, here + np.array([0.0, 0.0, turn]))


def _kept(recorded: _T | None, name: str) -> _T:
    if recorded is None:
        raise ValueError(f"demonstration {name}: teach and repeat needs images and odometry")
    return recorded

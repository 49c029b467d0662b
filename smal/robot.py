"""`Robot` takes an image and returns a motion; `Localizer` (the filter and the wheels) and `Planner` do the work."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from smal.features.detectors import Detection
from smal.features.percept import Percept, perceive
from smal.filter import Belief, Filter
from smal.map import beside, way_from
from smal.model import Model
from smal.movement import BY_ATOMS, BY_ODOMETRY, STANDS, STILL, Atom, Motion, Movement
from smal.obstacles.clearance import Mount, Surroundings
from smal.obstacles.strange import GROUND_CONFIG, swept
from smal.particles import FILTER_CONFIG, FilterConfig
from smal.planning import Decision, Planner, Said, chosen_goal
from smal.sought.sight import TARGET_CONFIG
from smal.sought.witness import Glimpse, Witness

NO_GROUND = "the model does not know how the ground looks, which a robot that watches goes by; learn it again"


class Located(NamedTuple):
    """Where a robot is after one frame, and what it sees there: all that a decision goes by but obstacles."""

    whole: Belief  # Over all particles.
    belief: Belief  # Over the heaviest places.
    seen: Glimpse | None  # Whether what is sought is in view; None where nothing can tell.
    strange: float  # How far ahead the ground looks like none of the taught ground; infinity where none does.


@dataclass(frozen=True)
class TaughtPlace:
    """Where in what was taught."""

    drive: int
    frame: int  # Counted over all drives of the map.
    ahead: float  # Of the robot as seen from there, with `left`: metres, or forward atoms without odometry.
    left: float
    turned_rad: float  # To the left.
    probability: float  # Of being beside that frame, given that the robot is not lost.


class Localizer:
    """Follows a robot from frame to frame by its features, and by its odometry or what its atoms usually do.

    The seed is of the filter's noise; `goal` is where it is sent, and may be left out where all drives lead to one. One
    that `watches` looks for strange ground: ValueError where the model does not know the ground.
    """

    def __init__(
        self,
        model: Model,
        seed: int = 0,
        goal: str | None = None,
        watches: bool = False,
        config: FilterConfig = FILTER_CONFIG,
    ) -> None:
        if watches and model.ground is None:
            raise ValueError(NO_GROUND)
        self._watches = watches
        self._map = mapped = model.mapped
        self.features = model.feature_settings  # That it goes by.
        self._ground = model.ground
        self._filter = Filter(mapped, model.centering, seed, config)
        goal = mapped.goals[0] if goal is None and len({*mapped.goals}) == 1 else goal
        sight = model.sights.get(goal or "")
        word = model.words.get(goal or "")
        self._witness = Witness(sight, word) if sight or word else None
        to_end = (mapped.key_poses - mapped.key_poses[mapped.key_range[1]])[:, :2]
        self._near = (mapped.key_goals == goal) & (
            np.hypot(*to_end.T) <= TARGET_CONFIG.approach_s * mapped.speed
        )
        self.reset()

    def reset(self, belief: Belief | None = None, pose: Sequence[float] | None = None) -> None:
        """Forget everything, for a new episode, or but a belief, and the pose by the wheels at its frame."""
        self._filter.reset(belief)
        self._pose = pose if self._map.odometry else None
        self._since_near = math.inf
        self._time_s = 0.0
        self._strange_s = 0.0
        self._step_s = 0.0
        self._strange = math.inf
        if self._witness is not None:
            self._witness.reset()

    def locate(
        self,
        percept: Percept,
        odometry: Sequence[float] | None = None,
        made: Sequence[Atom | Motion] = (),
        elapsed_s: float | None = None,
    ) -> Located:
        """Take one frame; odometry, what was made, time and errors are as in `observe`."""
        whole = self.observe(percept.features, odometry, made, elapsed_s)
        seen = self.seen(percept.picture, whole, percept.detected)
        belief = whole.summary()
        return Located(
            whole,
            belief,
            seen,
            self.strange(percept.picture, belief) if self._watches else math.inf,
        )

    def seen(
        self, picture: NDArray[np.uint8] | None, belief: Belief, detected: Iterable[Detection] = ()
    ) -> Glimpse | None:
        """Return whether what is sought is in view of a frame (`resizing.small`); None where nobody knows.

        `detected` is what the detectors among the features find in it (`smal.features.extraction.detect`).
        Far from where it was taught to be, nobody looks; who turns there is still there, whatever that looks like.
        """
        if self._witness is None:
            return None
        if float(belief.weights @ self._near[belief.keyframes]) >= 0.5:
            self._since_near = 0.0
        if self._since_near > self._map.correlation_length:
            self._witness.reset()
            return Glimpse(0.0, 0.0)
        return (
            Glimpse(0.0, 0.0)
            if picture is None
            else self._witness.look(picture, self._time_s, detected)
        )

    def strange(self, picture: NDArray[np.uint8] | None, belief: Belief) -> float:
        """Return how far ahead the ground looks like none of the taught ground, in the map's unit (`PlannerConfig`).

        It is infinity where nothing does, and where the model does not know the ground.
        """
        best = int(belief.weights.argmax())
        if self._ground is None or picture is None or belief.lost > 0.5:
            self._strange_s = 0.0
            self._strange = math.inf
        elif abs(belief.offsets[best, 2]) < math.radians(self._map.config.spacing_deg):
            key = int(belief.keyframes[best])
            way = way_from(self._map, key, belief.offsets[best], swept(self._map.speed))
            far = self._ground.strange_m(
                picture, beside(self._map, key, GROUND_CONFIG.keyframes), way, self._map.scene
            )
            # What shows for a moment is none.
            self._strange_s = self._strange_s + self._step_s if math.isfinite(far) else 0.0
            self._strange = far if self._strange_s >= GROUND_CONFIG.lasts_s else math.inf
        # Turned aside it sees what the taught views have not shown, and what it saw is still there.
        return self._strange

    def observe(
        self,
        raw_features: NDArray[Any],
        odometry: Sequence[float] | None = None,
        atoms: Sequence[Atom | Motion] = (),
        elapsed_s: float | None = None,
    ) -> Belief:
        """Take the features (m,) of one frame, of `smal.features.extract`.

        Odometry is the pose by the wheels at the frame, x, y and heading in radians; it does not count where the drives
        had none: the map then has another unit. Atoms were made since the frame before, for equal parts of the time;
        they count where there is no odometry. A frame without either says nothing of the movement: the next pose does.
        `elapsed_s` is the time since the frame before, a taught tick if not given. ValueError for a time or a pose that
        is not finite, a negative time, or as `Filter.observe`.
        """
        if elapsed_s is not None and not (math.isfinite(elapsed_s) and elapsed_s >= 0.0):
            raise ValueError(
                f"the time since the frame before must be finite and not negative, got {elapsed_s}"
            )
        odometry = odometry if self._map.odometry else None
        if odometry is not None and not all(map(math.isfinite, odometry)):
            raise ValueError(f"the pose by the wheels must be finite, got {tuple(odometry)}")
        movement = STILL
        noise = BY_ATOMS
        if odometry is not None and self._pose is not None:
            movement = Movement.between(self._pose, odometry)
            noise = BY_ODOMETRY
        elif atoms:
            movement = self._usual_movement(atoms, elapsed_s)
        belief = self._filter.observe(raw_features, movement, noise)
        self._since_near += abs(movement.ahead)
        self._strange = max(self._strange - movement.ahead, 0.0)
        self._step_s = self._map.tick_s if elapsed_s is None else elapsed_s
        self._time_s += self._step_s
        # Not before: a frame that is refused is not taken in.
        if odometry is not None or atoms:
            self._pose = odometry
        return belief

    def _usual_movement(self, atoms: Sequence[Atom | Motion], elapsed_s: float | None) -> Movement:
        """Return the movement that atoms or motions, made for equal parts of a time, usually are."""
        ticks = len(atoms) if elapsed_s is None else elapsed_s / self._map.tick_s
        table = self._map.movements
        full = table[Atom.FORWARD, 0], table[Atom.LEFT, 1]
        made = [np.multiply(one, full) if isinstance(one, tuple) else table[one] for one in atoms]
        ahead, turn = np.mean(made, axis=0) * ticks
        return Movement(float(ahead), float(turn))


class Robot:
    """Finds the goal: takes an image, gives the motion to make next.

    The goal may be left out where all drives lead to one. The seed is of the filter's noise. A robot that `watches`
    stops before ground that looks strange, where it has no depth. ValueError where the model has not this goal, or
    several and none is named, or does not know the ground.
    """

    belief: Belief  # After the last image.
    decision: Decision

    def __init__(
        self, model: Model, goal: str | None = None, seed: int = 0, watches: bool = False
    ) -> None:
        self._map = model.mapped
        goal = chosen_goal(model.mapped.goals, goal)
        self._localizer = Localizer(model, seed, goal, watches)
        self._planner = Planner(model.mapped, goal)
        self.reset()

    def reset(self) -> None:
        """Forget everything, for a new episode."""
        self._localizer.reset()
        self._planner.reset()
        #: What it has made since the last image: the motion of `step`, unless its owner sets another one, or an atom.
        self.made: Atom | Motion = STANDS
        self._around: Surroundings | None = None

    def step(
        self,
        image: NDArray[np.uint8],
        odometry: Sequence[float] | None = None,
        elapsed_s: float | None = None,
        depth: tuple[NDArray[np.float32], Mount] | None = None,
    ) -> Motion:
        """Take one image (height, width, 3), RGB; return the motion to make until the next one.

        A motion is a linear velocity, ahead, and an angular velocity, to the left, as shares of the robot's own, -1 to
        1. Odometry is the pose by the wheels at the image, x, y and heading in radians; without it the robot is taken
        to have made the last motion. `elapsed_s` is the time since the image before, as between taught images if
        not given. `depth` is what a depth camera measures (height, width), metres, 0 where nothing, and how it sits:
        with it, and odometry, the robot goes round what stands in its way.
        """
        located = self._localizer.locate(
            perceive(image, self._localizer.features), odometry, [self.made], elapsed_s
        )
        self.belief = located.whole
        if odometry is None:
            self._around = None
        elif depth is not None:
            self._around = self._around or Surroundings(depth[1].radius_m)
            self._around.look(odometry, *depth)
        elif self._around is not None:
            self._around.move(odometry)
        self.decision = self._planner.decide(
            located.belief,
            elapsed_s,
            seen=located.seen,
            around=self._around,
            strange=located.strange,
        )
        self.made = self.decision.motion
        return self.decision.motion

    @property
    def where(self) -> TaughtPlace:
        """The likeliest place."""
        best = self.belief.summary(1)
        frame = int(self._map.keyframes[best.keyframes[0]])
        share = float(self.belief.weights[self.belief.keyframes == best.keyframes[0]].sum())
        ahead, left, turned = best.offsets[0].tolist()
        return TaughtPlace(int(self._map.drives[frame]), frame, ahead, left, turned, share)

    @property
    def lost(self) -> bool:
        """Whether the robot is more likely lost than not."""
        return self.belief.lost > 0.5

    @property
    def said(self) -> Said | None:
        """What it says of the goal, having nothing left to do."""
        return self._planner.said

    @property
    def done(self) -> bool:
        """Whether it has said something of its goal."""
        return self.said is not None

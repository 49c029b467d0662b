"""`Robot`: from a camera image to a motion, by the `Localizer` (filter and odometry) and the `Planner`."""

import math
import warnings
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np

from smal.arrays import AnyArray, Float32s, Floats, Uint8s
from smal.camera import TURNS_DEG
from smal.camera_change import CameraPitch
from smal.features import extract
from smal.features.detectors import Detection
from smal.features.percept import Percept, perceive
from smal.features.resizing import same_aspect
from smal.filter import Belief, Filter
from smal.map import beside, way_from
from smal.model import Model
from smal.movement import (
    BY_ATOMS,
    BY_ODOMETRY,
    STANDS,
    STILL,
    Atom,
    Motion,
    Movement,
    is_pose,
    placed,
)
from smal.obstacles.clearance import Mount, Surroundings
from smal.obstacles.ground import GROUND_CONFIG, swept
from smal.particles import FILTER_CONFIG, FilterConfig
from smal.planning import Decision, Planner, Said
from smal.target.appearance import TARGET_CONFIG
from smal.target.detector import TargetDetector, TargetEstimate

NO_GROUND = (
    "the model has no ground, so that unexpected ground cannot be detected; learn the model again"
)

#: Images at the start of an episode whose colours are checked.
_COLOURS_CHECKED: Final = 10
#: Mean gain of cosine by swapped colours: right images lose about 0.08 (a room, 20 drives).
_CLEARLY_SWAPPED: Final = 0.01


class Located(NamedTuple):
    """Result of one frame: the belief, and the view of the target and of the ground."""

    #: Belief over all particles.
    whole: Belief
    #: Belief over the heaviest places.
    belief: Belief
    #: Probability that the target is in view; None without a target detector.
    target: TargetEstimate | None
    #: Distance to unexpected ground ahead, in the map's unit; infinite if the ground is as taught.
    unexpected_ground: float


@dataclass(frozen=True)
class TaughtPlace:
    """A place on a taught drive, and the robot's offset from it."""

    drive: int
    #: Number of the frame, counted over all drives of the map.
    frame: int
    #: Offset of the robot from that frame, with `left`: metres, or forward atoms without odometry.
    ahead: float
    left: float
    #: Turn to the left.
    turned_rad: float
    #: Probability that the robot is beside that frame, given that it is not lost.
    probability: float


class Localizer:
    """Estimates the robot's place from frame to frame by features, and by odometry or the usual movement of atoms.

    Parameters
    ----------
    model : Model
    seed : int
        Seed of the filter's noise.
    goal : str, optional
        Goal of the robot. It can be omitted if all drives lead to the same goal.
    watches : bool
        Whether to detect unexpected ground.
    config : FilterConfig

    Raises
    ------
    ValueError
        If `watches` is set and the model has no ground.
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
        #: Features that the model was learned on.
        self.features = model.feature_settings
        self._ground = model.ground
        self._filter = Filter(mapped, model.centering, seed, config)
        self._pitch = CameraPitch(mapped, model.centering)
        if goal is None and len({*mapped.goals}) == 1:
            goal = mapped.goals[0]
        appearance = model.appearances.get(goal or "")
        label = model.labels.get(goal or "")
        self._detector = TargetDetector(appearance, label) if appearance or label else None
        _, last = mapped.key_range
        to_end = (mapped.key_poses - mapped.key_poses[last])[:, :2]
        near_end = np.hypot(*to_end.T) <= TARGET_CONFIG.approach_s * mapped.speed
        self._near = (mapped.key_goals == goal) & near_end
        self.reset()

    def reset(
        self,
        belief: Belief | None = None,
        pose: Sequence[float] | None = None,
        seed: int | None = None,
    ) -> None:
        """Start a new episode, optionally from a belief and the odometry pose at its frame.

        The seed is that of this and the following episodes; by default it stays.
        """
        self._filter.reset(belief, seed)
        self._pitch.reset(0.0 if belief is None else belief.pitch_deg)
        self._pose = pose if self._map.odometry else None
        self._since_near = math.inf
        self._time_s = 0.0
        self._unexpected_s = 0.0
        self._step_s = 0.0
        self._movement = STILL
        self._unexpected_ground = math.inf
        if self._detector is not None:
            self._detector.reset()

    def locate(
        self,
        percept: Percept,
        odometry: Sequence[float] | None = None,
        executed: Sequence[Atom | Motion] = (),
        elapsed_s: float | None = None,
    ) -> Located:
        """Process one frame; odometry, motions, time and errors are as in `observe`."""
        picture = percept.picture
        percept = self._pitch.levelled(percept)
        whole = self.observe(percept.features, odometry, executed, elapsed_s)
        whole = replace(whole, pitch_deg=self._pitch.pitch_deg)
        target = self.target(percept.picture, whole, percept.detected)
        belief = whole.summary()
        self._compare(picture, belief)
        unexpected_ground = (
            self.unexpected_ground(percept.picture, belief) if self._watches else math.inf
        )
        return Located(whole, belief, target, unexpected_ground)

    def _compare(self, picture: Uint8s | None, belief: Belief) -> None:
        """Compare a small picture with the map, for the pitch of the camera."""
        best = int(belief.keyframes[0])
        near = np.zeros(len(self._map.keyframes), dtype=np.bool_)
        near[beside(self._map, best, self._map.config.neighbours)] = True
        # A robot that looks away from the way sees nothing that the map shows at another pitch.
        facing = np.abs(belief.offsets[:, 2]) <= math.radians(TURNS_DEG.max())
        certainty = (1.0 - belief.lost) * float(belief.weights @ (near[belief.keyframes] & facing))
        picture = picture if belief.camera == "sees" else None
        lengths = abs(self._movement.ahead) / self._map.correlation_length
        before = self._pitch.pitch_deg
        if belief.is_lost:
            # A pitch that was estimated at a wrong place hides the right one.
            self._pitch.reset()
        self._pitch.compare(picture, best, certainty, lengths)
        if self._pitch.pitch_deg != before:
            self._filter.forget_view()

    def target(
        self, picture: Uint8s | None, belief: Belief, detected: Iterable[Detection] = ()
    ) -> TargetEstimate | None:
        """Return the probability that the target is in view.

        The target detector runs only near a taught goal. Turning on the spot keeps it active, whatever the belief.

        Parameters
        ----------
        picture : array, optional
            Small picture of the frame (`smal.features.resizing.small`).
        belief : Belief
        detected : iterable of Detection
            Detections of the frame (`smal.features.extraction.detect`).

        Returns
        -------
        TargetEstimate or None
            None without a target detector.
        """
        if self._detector is None:
            return None
        near = belief.weights * self._near[belief.keyframes]
        place = self._before_end(belief, near) if near.sum() >= 0.5 else None
        if place is not None:
            self._since_near = 0.0
        if self._since_near > self._map.correlation_length:
            self._detector.reset()
            return TargetEstimate(0.0, 0.0)
        if picture is None:
            return TargetEstimate(0.0, 0.0)
        return self._detector.observe(picture, self._time_s, detected, place)

    def _before_end(self, belief: Belief, weights: Floats) -> tuple[float, float]:
        """Return the distance from the ends of drives, and its deviation, in seconds of driving."""
        mapped = self._map
        poses = placed(belief.offsets, mapped.key_poses[belief.keyframes])
        ends = mapped.key_poses[mapped.key_range[1][belief.keyframes]]
        away_s = np.hypot(*(poses - ends)[:, :2].T) / max(mapped.speed, 1e-9)
        mean_s = float(np.average(away_s, weights=weights))
        deviation_s = math.sqrt(np.average((away_s - mean_s) ** 2, weights=weights))
        return mean_s, deviation_s

    def unexpected_ground(self, picture: Uint8s | None, belief: Belief) -> float:
        """Return the distance to unexpected ground ahead, in the map's unit; infinite if the ground is as taught."""
        best = int(belief.weights.argmax())
        offset = belief.offsets[best]
        if self._ground is None or picture is None or belief.is_lost:
            self._unexpected_s = 0.0
            self._unexpected_ground = math.inf
        elif abs(offset[2]) < math.radians(self._map.config.spacing_deg):
            key = int(belief.keyframes[best])
            way = way_from(self._map, key, offset, swept(self._map.speed))
            neighbours = beside(self._map, key, GROUND_CONFIG.keyframes)
            far = self._ground.unexpected(picture, neighbours, way, self._map)
            # A momentary detection is ignored.
            self._unexpected_s = self._unexpected_s + self._step_s if math.isfinite(far) else 0.0
            self._unexpected_ground = (
                far if self._unexpected_s >= GROUND_CONFIG.lasts_s else math.inf
            )
        # A robot that is turned aside sees untaught ground; the last detection stays valid.
        return self._unexpected_ground

    def observe(
        self,
        raw_features: AnyArray,
        odometry: Sequence[float] | None = None,
        executed: Sequence[Atom | Motion] = (),
        elapsed_s: float | None = None,
    ) -> Belief:
        """Update the belief by the features of one frame.

        Parameters
        ----------
        raw_features : array (m,)
            From `smal.features.extract`.
        odometry : sequence (3,), optional
            Odometry pose at the frame: x, y, and heading in radians. It is ignored if the map was taught without
            odometry, because the map then has another unit.
        executed : sequence of Atom or Motion
            Executed since the frame before, for equal parts of the time. Used only without odometry. For a frame
            without atoms and odometry, the movement follows from the next pose.
        elapsed_s : float, optional
            Time since the frame before, seconds; by default a taught tick.

        Raises
        ------
        ValueError
            If the time is negative, the time or the pose is not finite, or as in `Filter.observe`.
        """
        if elapsed_s is not None and not (math.isfinite(elapsed_s) and elapsed_s >= 0.0):
            raise ValueError(
                f"the time since the frame before must be finite and not negative, got {elapsed_s}"
            )
        odometry = odometry if self._map.odometry else None
        if odometry is not None and not is_pose(odometry):
            raise ValueError(
                "the pose by the wheels must be three finite numbers, x, y and heading in radians, "
                f"got {odometry!r:.60}"
            )
        movement = STILL
        noise = BY_ATOMS
        if odometry is not None and self._pose is not None:
            movement = Movement.between(self._pose, odometry)
            noise = BY_ODOMETRY
        elif executed:
            movement = self._usual_movement(executed, elapsed_s)
        belief = self._filter.observe(raw_features, movement, noise)
        if noise is BY_ODOMETRY and _drives_ahead(executed):
            belief = replace(belief, moved=movement.ahead)
        self._movement = movement
        self._since_near += abs(movement.ahead)
        self._unexpected_ground = max(self._unexpected_ground - movement.ahead, 0.0)
        self._step_s = self._map.tick_s if elapsed_s is None else elapsed_s
        self._time_s += self._step_s
        # Only now: a rejected frame must not change the state.
        if odometry is not None or executed:
            self._pose = odometry
        return belief

    def _usual_movement(
        self, executed: Sequence[Atom | Motion], elapsed_s: float | None
    ) -> Movement:
        """Return the usual movement of atoms or motions that were executed for equal parts of a time."""
        ticks = len(executed) if elapsed_s is None else elapsed_s / self._map.tick_s
        table = self._map.movements
        full = table[Atom.FORWARD, 0], table[Atom.LEFT, 1]
        movements = [
            np.multiply(atom, full) if isinstance(atom, tuple) else table[atom] for atom in executed
        ]
        ahead, turn = np.mean(movements, axis=0) * ticks
        return Movement(float(ahead), float(turn))


def _drives_ahead(executed: Sequence[Atom | Motion]) -> bool:
    """Return whether all executed motions drive ahead, at half of the speed or more.

    A robot that was stopped, or slowed down before an obstacle, has touched nothing.
    """
    ahead = (
        atom[0] >= 0.5 if isinstance(atom, tuple) else atom == Atom.FORWARD for atom in executed
    )
    return bool(executed) and all(ahead)


def surroundings(
    before: Surroundings | None,
    odometry: Sequence[float],
    depth: tuple[Float32s | None, Mount] | None,
    elapsed_s: float,
    radius_m: float = 0.0,
) -> Surroundings | None:
    """Return the surroundings at an odometry pose, with a depth image and the mount of its camera.

    Parameters
    ----------
    before
        Surroundings of the call before; they begin anew when the mount changes the radius.
    odometry, depth
        As in `Robot.step`; the depth image can be None.
    elapsed_s
        Time since the call before, seconds.
    radius_m
        Radius of a robot without a mount, metres; 0 if unknown: then the surroundings begin with
        the first mount.
    """
    mount = None if depth is None else depth[1]
    if before is None and mount is None and radius_m <= 0.0:
        return None
    if before is None or (mount is not None and mount.radius_m != before.radius_m):
        before = Surroundings(radius_m if mount is None else mount.radius_m)
    if depth is None:
        before.move(odometry)
    else:
        before.observe(odometry, *depth, elapsed_s)
    return before


class Robot:
    """Drives to the goal: takes images and returns motions.

    Parameters
    ----------
    model : Model
    goal : str, optional
        Goal of the robot. It can be omitted if all drives lead to the same goal.
    seed : int
        Seed of the filter's noise.
    watches : bool
        Whether the robot stops before unexpected ground when it has no depth image.

    Raises
    ------
    ValueError
        If the goal is not found, or is missing although the model has several, or `watches` is set and the model has
        no ground.
    TypeError
        If the model is no `Model`.
    """

    belief: Belief  # After the last image.
    decision: Decision

    def __init__(
        self, model: Model, goal: str | None = None, seed: int = 0, watches: bool = False
    ) -> None:
        if not isinstance(model, Model):
            raise TypeError(
                f"a robot needs a smal.Model, got {model!r:.60}; smal.Model.load(path) reads a file"
            )
        self._model = model
        self._map = model.mapped
        goal = model.mapped.chosen_goal(goal)
        self._localizer = Localizer(model, seed, goal, watches)
        self._planner = Planner(model.mapped, goal)
        self.reset()

    def reset(self, seed: int | None = None) -> None:
        """Start a new episode.

        Parameters
        ----------
        seed : int, optional
            Seed of the filter's noise in this and the following episodes; by default as before.
        """
        self._localizer.reset(seed=seed)
        self._planner.reset()
        #: Motion since the last image: the result of `step`, unless the caller sets another motion or an atom.
        self.executed: Atom | Motion = STANDS
        self._around: Surroundings | None = None
        self._swapped: list[float] = []

    def step(
        self,
        image: Uint8s,
        odometry: Sequence[float] | None = None,
        elapsed_s: float | None = None,
        depth: tuple[Float32s, Mount] | None = None,
    ) -> Motion:
        """Return the motion until the next image.

        Parameters
        ----------
        image : array (height, width, 3)
            RGB, uint8.
        odometry : sequence (3,), optional
            Odometry pose at the image: x, y, and heading in radians. By default the last motion counts as executed.
        elapsed_s : float, optional
            Time since the image before, seconds; by default the time between taught images.
        depth : (array (height, width), Mount), optional
            Depth image in metres (0 = not measured), and the mount of its camera. With depth and odometry, the robot
            drives around obstacles; with odometry alone, around what it has touched.

        Returns
        -------
        (float, float)
            Linear velocity ahead and angular velocity to the left, as shares of the robot's own, -1 to 1.
        """
        percept = perceive(image, self._localizer.features)
        width, height = self._map.size
        if not same_aspect(image.shape, (height, width)):
            raise ValueError(
                f"an image of {image.shape[1]}x{image.shape[0]} shows another view than the taught "
                f"images of {width}x{height}; use the camera of the drive"
            )
        # One image that is less like the map when swapped settles it.
        if len(self._swapped) < _COLOURS_CHECKED and min(self._swapped, default=1.0) > 0.0:
            self._check_colours(image, percept.features)
        located = self._localizer.locate(percept, odometry, [self.executed], elapsed_s)
        self.belief = located.whole
        if odometry is None:
            self._around = None
        else:
            tick_s = self._map.tick_s if elapsed_s is None else elapsed_s
            self._around = surroundings(
                self._around, odometry, depth, tick_s, self._planner.radius_m
            )
        self.decision = self._planner.decide(
            located.belief,
            elapsed_s,
            target=located.target,
            around=self._around,
            unexpected_ground=located.unexpected_ground,
        )
        self.executed = self.decision.motion
        return self.decision.motion

    def _check_colours(self, image: Uint8s, features: Float32s) -> None:
        """Warn if the first images of an episode are more like the map with red and blue swapped."""
        other = extract(np.ascontiguousarray(image[..., ::-1]), self._localizer.features)
        swapped = self._likeness(other)
        # A robot that looks away from the way sees nothing taught, whatever the colours.
        taught = swapped > self._map.next_correlation
        self._swapped.append(swapped - self._likeness(features) if taught else 0.0)
        clear = min(self._swapped) > 0.0 and np.mean(self._swapped) > _CLEARLY_SWAPPED
        if len(self._swapped) == _COLOURS_CHECKED and clear:
            warnings.warn(
                "the images are like the taught images with red and blue swapped; give RGB, as "
                "cv2.cvtColor(image, cv2.COLOR_BGR2RGB) returns",
                stacklevel=3,
            )

    def _likeness(self, features: Float32s) -> float:
        """Return the cosine of a frame with the taught view that is most like it."""
        components = self._map.described(self._model.centering.apply(features))
        keyframes, _ = self._map.likely(components)
        return float(self._map.ahead_cosines(components, keyframes).max())

    @property
    def where(self) -> TaughtPlace:
        """The most likely place."""
        best = self.belief.summary(1)
        keyframe = best.keyframes[0]
        frame = int(self._map.keyframes[keyframe])
        share = self.belief.share(np.arange(len(self._map.keyframes)) == keyframe)
        ahead, left, turned = best.offsets[0].tolist()
        return TaughtPlace(int(self._map.drives[frame]), frame, ahead, left, turned, share)

    @property
    def lost(self) -> bool:
        """Whether the robot is more likely lost than not."""
        return self.belief.is_lost

    @property
    def said(self) -> Said | None:
        """Announced result of the search; None while the robot is under way."""
        return self._planner.said

    @property
    def done(self) -> bool:
        """Whether the robot has announced its result."""
        return self.said is not None

"""Where the robot is: a Bayes filter over taught places, the robot's offset there, and "lost".

The hidden state is a pose beside a taught keyframe: which keyframe, how far ahead and to the left of it, and how far
turned; or that the robot is nowhere near what was taught. A particle filter (Gordon, Salmond and Smith 1993; Thrun,
Burgard and Fox 2005, chapters 4 and 8) keeps it:

* *Prediction* moves every particle by what the wheels say (or by what the atom usually does), with noise.
* *Update* weighs it by what the view says of its place (`smal.likelihood`), for as much of the view as is new. "Lost"
  has the likelihood 1, as a place elsewhere has.
* A *jump* is the one thing that the wheels do not tell: the robot was carried, or the filter follows a wrong place.
  It may happen with every new view, and is the likelier the less a view looks like the one just before.
* A second set of particles is where the robot is if it has jumped. Scouts join it with every view: drawn by what the
  view says, half of them near the last pose that was sure. When it has become the likelier one, the two become one.

The paper instead matches the last l frames anew at every decision (`smal.paper.recognition`): without a memory, places
that look alike for longer than l frames are not told apart.
"""

import math
from dataclasses import dataclass, replace
from typing import Any, Final, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from smal.camera import STEP_DEG, TURNS_DEG
from smal.features import Centering
from smal.frozen import Frozen
from smal.likelihood import scale
from smal.map import VisualMap
from smal.movement import BY_ODOMETRY, STILL, MotionNoise, Movement, placed
from smal.particles import FILTER_CONFIG, FilterConfig, Particles, ViewEvidence, systematic

#: Whether the last picture showed anything: a picture without texture shows nothing, nor does one that stays the same
#: while the wheels move.
CameraState = Literal["sees", "blank", "frozen"]


PLACES: Final = 64  # Places that a decision is made of, the heaviest.


@dataclass(frozen=True, eq=False)
class Belief:
    """Where the robot may be: p particles beside keyframes, and how probable each is."""

    keyframes: NDArray[np.intp]
    #: (p, 3) how far ahead and to the left of its keyframe each is, in the map's unit, and turned left, radians.
    offsets: NDArray[np.float64]
    weights: NDArray[np.float64]  # Probabilities given that the robot is not lost; they sum to 1.
    lost: float  # Probability, 0 to 1, that the robot is nowhere near what was taught.
    cosine: float  # Mean cosine of the last view with the views of these places.
    #: Way that nine tenths of the weight have been followed for, since they were drawn, in the map's unit.
    tracked: float
    #: Logarithm of how much likelier the last view was, after all before it, than a view of elsewhere.
    evidence: float = 0.0
    unseen: float = 0.0  # Way since a view last spoke for the robot's place, in the map's unit.
    camera: CameraState = "sees"

    def summary(self, most: int = PLACES) -> "Belief":
        """Return it with one particle for each keyframe, their mean: at most so many, the heaviest."""
        keys, where = np.unique(self.keyframes, return_inverse=True)
        weights = np.bincount(where, self.weights)
        safe = np.maximum(weights, 1e-300)
        ahead, left, turned = self.offsets.T
        # The mean of turns is that of directions: those of a robot that looks back are on both sides of half a turn.
        columns = (ahead, left, np.cos(turned), np.sin(turned))
        x, y, cos, sin = (np.bincount(where, self.weights * column) / safe for column in columns)
        mean = np.stack([x, y, np.arctan2(sin, cos)], axis=1)
        order = np.argsort(-weights, kind="stable")[:most]
        order = order[weights[order] > 0.0]
        kept = weights[order] / weights[order].sum()
        return replace(self, keyframes=keys[order], offsets=mean[order], weights=kept)


class _Odds(NamedTuple):
    """Of the tracked particles; of those that jumped; of the scouts that will be sent; of being lost."""

    tracked: float
    jumped: float
    sent: float
    lost: float


class Newness:
    """How new a view is, 0 to 1: the part of it that earlier views did not already tell.

    It is new against the last one that was counted in full, by its looks. A robot that drives compares it with other
    places, too: half of what two views say alike is owed to the places, which change by the way. So many small changes
    make one new view; one that comes back, or noise while the robot stands, makes none.
    """

    def __init__(self, visual_map: VisualMap) -> None:
        self._map = visual_map
        self._counted = self._last = np.zeros(len(visual_map.basis), dtype=np.float32)
        self._used = 0.0
        self.step = np.zeros(3)

    def of(self, centred: NDArray[np.float32]) -> float:
        """Return how new the next view is, by its centred features (m,), and remember it.

        Its components would not do: of what the map has never seen they hold little but noise, always new.
        """
        if (
            self._map.likelihood.correlation(float(centred @ self._last))
            < self._map.next_correlation
        ):
            self._used = 0.0  # What has been told was of something else.
        self._last = centred
        looks = self._map.likelihood.correlation(float(centred @ self._counted))
        same = min(looks, math.sqrt(looks * self._map.expected(self.step)))
        new = (1.0 - same) / (1.0 + same)
        newness = max(new - self._used, 0.0)
        self._used = max(new, self._used)
        if same < self._map.next_correlation:
            self._counted = centred
            self._used = 0.0
            self.step = np.zeros(3)
        return newness


class Filter:
    """Follows the robot from frame to frame.

    Parameters
    ----------
    visual_map : VisualMap
    centering : Centering
        Of the features.
    seed : int
        Of the particles' noise: the same frames and movements give the same belief.
    config : FilterConfig
    """

    def __init__(
        self,
        visual_map: VisualMap,
        centering: Centering,
        seed: int = 0,
        config: FilterConfig = FILTER_CONFIG,
    ) -> None:
        self._map = visual_map
        self._config = config
        self._centering = centering
        self._seed = seed
        # Made here, and not while the first frame waits.
        _ = visual_map.neighbour_cosines, visual_map.sample, visual_map.overview
        self.reset()

    def reset(self, belief: Belief | None = None) -> None:
        """Forget everything, for a new episode; or but a belief, which may be a summary."""
        self._rng = np.random.default_rng(self._seed)
        keyframes = self._rng.choice(np.unique(self._map.key_range[0]), self._config.particles)
        aside = max(self._map.aside, self._config.start_s * self._map.speed)
        self._tracked = self._beside(
            keyframes, np.zeros(keyframes.size), aside, self._config.first_turn_deg
        )
        self._jumped: Particles | None = None
        at_start, anywhere, lost = self._config.first
        self._odds = _Odds(at_start, 0.0, anywhere, lost)
        self._newness = Newness(self._map)
        self._frozen = Frozen(self._map)
        self._started = False
        self._unseen = 0.0
        self._camera: CameraState = "sees"
        #: The last view that told something, and the step from there.
        self._last = np.zeros(self._map.basis.shape[1], dtype=np.float32)
        self._since = np.zeros(3)
        #: Drive and pose where it was last sure to be, moved on by the wheels, and the way since.
        self._sure: tuple[int, NDArray[np.float64], float] | None = None
        if belief is not None:
            which = systematic(belief.weights, self._config.particles, self._rng)
            keyframes = belief.keyframes[which]
            between = self._map.correlation_length / self._map.config.views_a_length
            self._tracked = self._beside(
                keyframes, np.zeros(which.size), between / 2.0, STEP_DEG / 2.0
            )
            here = self._map.key_poses[keyframes]
            self._tracked.poses += placed(belief.offsets[which], here) - here
            self._tracked.tracked += belief.tracked
            self._odds = _Odds(1.0 - belief.lost, 0.0, 0.0, belief.lost)
            self._started = True

    def observe(
        self,
        raw_features: NDArray[Any],
        movement: Movement = STILL,
        noise: MotionNoise = BY_ODOMETRY,
    ) -> Belief:
        """Take one frame.

        Parameters
        ----------
        raw_features : array (m,)
            From `smal.features.extract`.
        movement : Movement
            Since the frame before; that before the first frame does not count.
        noise : MotionNoise
            Of the movement.

        Raises
        ------
        ValueError
            Features of the wrong length, or features or a movement that are NaN or infinite: the frame does not count.
        """
        if raw_features.ndim != 1:
            raise ValueError(
                f"the features of one frame are wanted, got the shape {raw_features.shape}"
            )
        if not (math.isfinite(movement.ahead) and math.isfinite(movement.turn_rad)):
            raise ValueError(
                f"a movement must be finite, got {movement.ahead} ahead and a turn of {movement.turn_rad}"
            )
        centred = self._centering.apply(raw_features)
        step = np.array([movement.ahead, 0.0, movement.turn_rad])
        if self._started:
            self._since = placed(step, self._since)
        self._newness.step = placed(step, self._newness.step)
        self._frozen.look(centred, step if self._started else np.zeros(3))
        seen = self._seen(centred)
        if self._started:
            self._jump(seen, movement)
            self._move(movement, noise, seen.newness)
            if self._sure is not None:
                drive, pose, way = self._sure
                self._sure = drive, placed(step, pose), way + abs(movement.ahead)
        self._odds = self._odds._replace(
            tracked=max(self._odds.tracked, 1e-12)
        )  # From 0 it never came back.
        self._started = True
        self._evidence = 0.0
        if seen.newness > 0.0:
            self._last = seen.components
            self._since = np.zeros(3)
            self._weigh(seen)
            self._note_sure()
        self._note_seen(seen, abs(movement.ahead))
        return self._belief(seen)

    def _seen(self, centred: NDArray[np.float32]) -> ViewEvidence:
        """Compare a view with those of the map.

        It shows no place if it looks most like a blank picture, equally like all places, is the last one to the bit, or
        stays the same while the wheels move.
        """
        components = self._map.described(centred)
        keyframes, stand_for = self._map.likely(components)
        places = np.full(TURNS_DEG.size, 1)
        turns = np.arange(TURNS_DEG.size)
        cosines = self._map.best_look(
            keyframes, lambda _, rows: self._map.cosines(components, rows[:, None], places, turns)
        )
        middle, spread = scale(self._map.sample @ components)
        like_blank = float(components @ self._map.blank)
        blank = not components.any() or spread <= 1e-6 or like_blank > cosines.max()
        # A view of what was not taught may be less like a taught view than like none, and yet show something.
        dead = blank and (like_blank > 0.5 or not components.any())
        self._camera = "blank" if dead else "frozen" if self._frozen.yes else "sees"
        if blank or self._frozen.yes or np.array_equal(components, self._last):
            return ViewEvidence(components, keyframes, stand_for, cosines, middle, 0.0, 0.0)
        return ViewEvidence(
            components, keyframes, stand_for, cosines, middle, spread, self._newness.of(centred)
        )

    def _jump(self, seen: ViewEvidence, movement: Movement) -> None:
        """Move probability from the followed particles to scouts and to "lost".

        With every new view a little; much more where it does not look like the one just before, though the robot has
        hardly moved. Without views the wheels alone are believed less and less.
        """
        tracked, jumped, sent, lost = self._odds
        if seen.spread == 0.0:
            kept = 0.5 ** (self._map.lengths(movement) / self._config.blind)
            self._odds = _Odds(
                kept * tracked, kept * jumped, sent, lost + (1.0 - kept) * (tracked + jumped)
            )
            return
        like_last = float(self._map.likelihood.of(seen.stands_out(seen.components @ self._last)))
        # Of a view that is unlike the last one, either the robot has jumped, or something hides one of the two.
        visible = 1.0 - float(self._tracked.shares[0])
        rise = visible * math.expm1(max(-self._map.expected(self._since) * like_last, 0.0))
        jump = (
            self._config.jump
            * seen.newness
            * (1.0 + rise)
            / (
                1.0
                + (self._config.jump + self._config.hides(self._map.config.hidden))
                * seen.newness
                * rise
            )
        )
        _, anywhere, nowhere = self._config.first
        out = nowhere / (anywhere + nowhere)
        back = self._config.back * seen.newness
        gone = (tracked + jumped) * jump
        found = lost * back
        kept = 1.0 - jump
        self._odds = _Odds(
            tracked * kept,
            jumped * kept,
            sent + (gone * (1.0 - out) + found),
            lost - found + gone * out,
        )

    def _move(self, movement: Movement, noise: MotionNoise, newness: float) -> None:
        """Predict; a robot that is nowhere near what was taught any more is lost."""
        tracked, jumped, sent, lost = self._odds
        strayed = tracked * self._tracked.move(movement, noise, newness, self._rng)
        others = (
            0.0
            if self._jumped is None
            else jumped * self._jumped.move(movement, noise, newness, self._rng)
        )
        self._odds = _Odds(tracked - strayed, jumped - others, sent, lost + strayed + others)

    def _weigh(self, seen: ViewEvidence) -> None:
        """Weigh all by a view, and send scouts.

        What nobody taught looks like taught places more often than these look like each other: by how far the followed
        robot looks away, the view counts less.
        """
        tracked, jumped, sent, lost = self._odds
        looks = float(self._tracked.weights @ self._tracked.looks())
        seen = seen._replace(newness=seen.newness * (looks + (1.0 - looks) * self._config.untaught))
        # Scouts take the shares from before this view: that it is unlike the followed place says nothing of others.
        shares = self._tracked.shares
        tracked *= self._tracked.update(seen, self._rng)
        if self._jumped is not None:
            jumped *= self._jumped.update(seen, self._rng)
        scouts, likelihood = self._scouts(seen, shares)
        sent *= likelihood
        if self._jumped is not None:
            scouts = Particles.joined((self._jumped, jumped), (scouts, sent)).resampled(self._rng)
        self._jumped = scouts
        jumped = jumped + sent
        if jumped > tracked:
            self._tracked = Particles.joined((self._tracked, tracked), (scouts, jumped)).resampled(
                self._rng
            )
            self._jumped = None
            tracked = tracked + jumped
            jumped = 0.0
        total = tracked + jumped + lost
        self._odds = _Odds(tracked / total, jumped / total, 0.0, lost / total)
        self._evidence = math.log(total)

    def _scouts(self, seen: ViewEvidence, shares: NDArray[np.float64]) -> tuple[Particles, float]:
        """Draw particles by what one view says, where half is expected near the last sure pose, half anywhere.

        The second value is the likelihood of the view there.
        """
        z = seen.stands_out(seen.cosines)
        says = self._map.likelihood.mixed(shares, z, 1.0)
        new = self._map.likelihood.mixed(shares, z, seen.newness)
        prior = seen.stand_for / (seen.stand_for.sum() * TURNS_DEG.size)
        if self._sure is not None:
            drive, pose, way = self._sure
            reach = self._map.correlation_length + self._config.slip * way
            apart = np.hypot(*(self._map.key_poses[:, :2] - pose[:2]).T) / reach
            near = np.exp(-0.5 * np.square(apart)) * (self._map.key_drives == drive)
            near = near[seen.keyframes] / max(float(near.sum()), 1e-12)
            prior = 0.5 * prior + 0.5 * near / TURNS_DEG.size
        weights = prior[:, None] * says
        drawn = systematic(weights.ravel(), self._config.particles, self._rng)
        chosen, turns = np.divmod(drawn, TURNS_DEG.size)
        scouts = self._beside(
            seen.keyframes[chosen], np.radians(TURNS_DEG[turns]), self._map.aside, STEP_DEG / 2.0
        )
        # They are drawn by all that the view says, of which a part alone is new.
        rest = (new / says).ravel()[drawn]
        scouts.weights = rest / rest.sum()
        scouts.shares = shares
        return scouts, float((prior[:, None] * new).sum())

    def _beside(
        self,
        keyframes: NDArray[np.intp],
        turns: NDArray[np.float64],
        aside: float,
        turned_deg: float,
    ) -> Particles:
        """Scatter particles about keyframes."""
        spread = np.array([aside, aside, math.radians(turned_deg)])
        poses = (
            self._map.key_poses[keyframes]
            + self._rng.uniform(-1.0, 1.0, (len(keyframes), 3)) * spread
        )
        poses[:, 2] += turns
        made = Particles(self._map, keyframes, poses, self._config)
        made.pace = self._rng.standard_normal(len(poses))
        return made

    def _note_sure(self) -> None:
        """Remember the pose if it is sure: one place on one drive."""
        tracked = self._tracked
        drives = self._map.key_drives[tracked.keyframes]
        drive = int(drives[tracked.weights.argmax()])
        there = tracked.weights * (drives == drive)
        x, y, _ = there @ tracked.poses / max(float(there.sum()), 1e-12)
        heading = math.atan2(
            there @ np.sin(tracked.poses[:, 2]), there @ np.cos(tracked.poses[:, 2])
        )
        pose = np.array([x, y, heading])
        scatter = math.sqrt(float(there @ ((tracked.poses - pose)[:, :2] ** 2).sum(axis=1)))
        if (
            self._odds.tracked * float(there.sum()) > self._config.located
            and scatter < self._map.correlation_length
        ):
            self._sure = (drive, pose, 0.0)

    def _note_seen(self, seen: ViewEvidence, way: float) -> None:
        """Add up the way since a view last spoke for the followed place; looking away from all views, none can."""
        looks = float(self._tracked.weights @ self._tracked.looks())
        self._unseen = max(self._unseen + way * looks, self._frozen.way)
        if seen.spread > 0.0 and self._tracked.speaks > 1.0:
            self._unseen = 0.0

    def _belief(self, seen: ViewEvidence) -> Belief:
        tracked, jumped, _, lost = self._odds
        others = [] if self._jumped is None else [(self._jumped, jumped)]
        every = Particles.joined((self._tracked, tracked), *others)
        # Nine tenths of the weight are not below.
        order = np.argsort(every.tracked)
        least = min(int(np.searchsorted(np.cumsum(every.weights[order]), 0.1)), order.size - 1)
        return Belief(
            every.keyframes,
            every.offsets(),
            every.weights,
            lost / sum(self._odds),
            min(every.cosine(seen), 1.0),
            float(every.tracked[order[least]]),
            self._evidence,
            self._unseen,
            self._camera,
        )

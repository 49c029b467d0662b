"""Bayes filter over taught places, the robot's offset there, and the state "lost".

The hidden state is a pose beside a taught keyframe (the keyframe, the way ahead and to the left of it, the turn), or
"lost": far from everything that was taught. A particle filter (Gordon, Salmond and Smith 1993; Thrun, Burgard and Fox
2005, chapters 4 and 8) estimates it.

* *Prediction* moves each particle by the odometry, or by the usual movement of the atoms, with noise.
* *Update* weighs each particle by the likelihood of the view (`smal.likelihood`), for the part of the view that is
  new. "Lost" has the likelihood 1, like any other place.
* A *jump* covers movements that the odometry misses: the robot was carried (kidnapped), or the filter follows a
  wrong place. A jump can happen with every new view. A robot that was carried sees another view: the jump is more
  likely when the view differs from the view before, and less likely when it continues it.
* A robot that is switched on beside a way can look *away* from all taught views. While it turns, scouts test such
  places. The whole view is new evidence for them, because the views before showed other directions.
* A second set of particles follows the hypothesis of a jump. Scouts join it with every view. They are drawn by the
  likelihood of the view, half of them near the last certain pose. When this set becomes more likely than the first,
  the two sets are joined.

The paper instead matches the last l frames anew at every decision (`smal.paper.recognition`). Without a memory it
confuses places that look alike for longer than l frames.
"""

import math
from dataclasses import dataclass, replace
from typing import Final, Literal, NamedTuple

import numpy as np

from smal.arrays import AnyArray, Bools, Float32s, Floats, Indices
from smal.camera import STEP_DEG, TURNS_DEG
from smal.features import Centering
from smal.frozen import Frozen
from smal.likelihood import scale
from smal.map import VisualMap
from smal.movement import BY_ODOMETRY, STILL, MotionNoise, Movement, placed
from smal.particles import FILTER_CONFIG, FilterConfig, Particles, ViewEvidence, systematic

#: State of the camera. A picture without texture is "blank". A picture that stays the same while the wheels move is
#: "frozen".
CameraState = Literal["sees", "blank", "frozen"]

#: Share of all headings from which a robot beside a way looks at taught views.
_FACING: Final = TURNS_DEG.size * STEP_DEG / 360.0

#: Number of places in a summary of a belief, the heaviest first.
PLACES: Final = 64


@dataclass(frozen=True, eq=False)
class Belief:
    """Estimated position of the robot: p particles beside keyframes, and their probabilities."""

    keyframes: Indices
    #: (p, 3) way ahead and to the left of the keyframe, in the map's unit, and turn to the left, radians.
    offsets: Floats
    #: Probabilities given that the robot is not lost; they sum to 1.
    weights: Floats
    #: Probability, 0 to 1, that the robot is far from everything that was taught, or looks away from all of it at an
    #: unknown place.
    lost: float
    #: Mean cosine of the last view with the views of these places.
    cosine: float
    #: Way over which nine tenths of the weight have been followed since they were drawn, in the map's unit.
    tracked: float
    #: Log likelihood ratio of the last view, given all views before, to a view of elsewhere.
    evidence: float = 0.0
    #: Way since a view last supported the robot's place, in the map's unit.
    unseen: float = 0.0
    camera: CameraState = "sees"
    #: Sum of the certain evidence since the start, or since the robot was last lost; at least 0.
    support: float = math.inf
    #: Estimated angle by which the camera points further down than when it was taught.
    pitch_deg: float = 0.0
    #: Way ahead since the frame before, by odometry, in the map's unit, if the robot executed
    #: motions ahead; otherwise None.
    moved: float | None = None

    @property
    def is_lost(self) -> bool:
        """Whether the robot is more likely lost than not."""
        return self.lost > 0.5

    def share(self, keyframes: Bools) -> float:
        """Return the weight beside some keyframes, a mask (k,), given that the robot is not lost."""
        return float(self.weights @ keyframes[self.keyframes])

    def summary(self, most: int = PLACES) -> "Belief":
        """Return the belief with one mean particle for each keyframe.

        Parameters
        ----------
        most : int
            Maximum number of keyframes; the heaviest are kept.
        """
        keys, where = np.unique(self.keyframes, return_inverse=True)
        weights = np.bincount(where, self.weights)
        safe = np.maximum(weights, 1e-300)

        def mean(values: Floats) -> Floats:
            return np.asarray(np.bincount(where, self.weights * values) / safe)

        ahead, left, turned = self.offsets.T
        # Turns are averaged as directions: half a turn to the left and half a turn to the right are the same.
        mean_turn = np.arctan2(mean(np.sin(turned)), mean(np.cos(turned)))
        offsets = np.stack([mean(ahead), mean(left), mean_turn], axis=1)
        order = np.argsort(-weights, kind="stable")[:most]
        order = order[weights[order] > 0.0]
        kept = weights[order]
        return replace(
            self,
            keyframes=keys[order],
            offsets=offsets[order],
            weights=kept / kept.sum(),
        )


class _Odds(NamedTuple):
    """Probabilities of the hypotheses; after each view none is sent or turned in."""

    tracked: float
    jumped: float
    #: Scouts to send.
    sent: float
    #: Scouts to send for places from which the robot has looked away until now.
    turned_in: float
    #: Beside an unknown place of a way since the start, looking away from all taught views.
    away: float
    lost: float

    @property
    def unknown(self) -> float:
        """Probability that the robot is at no known place."""
        return self.away + self.lost


class Newness:
    """How new a view is, 0 to 1: the part of its information that earlier views did not contain.

    A view is compared with the last view that was counted in full. A moving robot also sees other
    places: half of the correlation of two views comes from the places, which change with the way.
    Therefore many small changes add up to one new view. A view that comes back, or noise while the
    robot stands, adds none. A turn changes a view fast, but a place that resembles the scene goes on
    resembling it: a turn counts as `VisualMap.repeated` measures it.
    """

    def __init__(self, visual_map: VisualMap) -> None:
        self._map = visual_map
        self._counted = self._last = np.zeros(len(visual_map.basis), dtype=np.float32)
        self._used = 0.0
        self._step = np.zeros(3)

    def move(self, step: Floats) -> None:
        """Follow the robot by a step: ahead, left, turned (3,)."""
        self._step = placed(step, self._step)

    def of(self, centred: Float32s) -> float:
        """Return how new the next view is, by its centred features (m,), and store it.

        Components are unsuitable: for a scene that the map does not contain they are mostly noise, which is always new.
        """
        correlation = self._map.likelihood.correlation
        like_last = correlation(float(centred @ self._last))
        if like_last < self._map.next_correlation:
            # The earlier views showed another scene.
            self._used = 0.0
        self._last = centred
        like_counted = correlation(float(centred @ self._counted))
        same = self._without_turn(like_counted, self._step) * self._map.repeated(self._step[2])
        new = _new(same)
        newness = max(new - self._used, 0.0)
        self._used = max(new, self._used)
        if same < self._map.next_correlation:
            self._counted = centred
            self._used = 0.0
            self._step = np.zeros(3)
        return newness

    def _without_turn(self, like: float, step: Floats) -> float:
        """Return the correlation of two views, a step apart, without the change by the turn."""
        ahead, left, turned = step
        by_turn = self._map.expected(np.array([0.0, 0.0, turned]))
        by_way = self._map.expected(np.array([ahead, left, 0.0]))
        like = min(like / max(by_turn, 1e-9), 1.0)
        return min(like, math.sqrt(like * by_way))


class SeenDirections:
    """How new a view is for certain, 0 to 1: by the odometry alone.

    A fast turn hides what else has changed in a view. But the way is new, and from one spot the
    directions in which the robot has not looked yet. Without odometry every view counts as new:
    the executed motions do not show how far the robot has turned.
    """

    def __init__(self, visual_map: VisualMap) -> None:
        self._map = visual_map
        self._pose: Floats | None = None  # Relative to the spot.
        self._range_rad = (0.0, 0.0)
        self._used = 0.0

    def move(self, step: Floats) -> None:
        """Follow the robot by a step: ahead, left, turned (3,)."""
        if self._pose is not None:
            self._pose = placed(step, self._pose)

    def new(self) -> float:
        """Return how new the next view is; the first is entirely new."""
        if self._pose is None or not self._map.odometry:
            self._pose = np.zeros(3)
            return 1.0
        ahead, left, heading = self._pose
        least, most = self._range_rad
        beyond = max(heading - most, least - heading, 0.0)
        unseen = max(math.tau - (most - least), 0.0)
        self._range_rad = (min(least, heading), max(most, heading))
        same = self._map.expected(np.array([ahead, left, 0.0]))
        by_way = max(_new(same) - self._used, 0.0)
        self._used = max(_new(same), self._used)
        if same < self._map.next_correlation:
            self._pose = np.zeros(3)
            self._range_rad = (0.0, 0.0)
            self._used = 0.0
        return min(by_way + _new(self._map.repeated(min(beyond, unseen))), 1.0)


def _new(same: float) -> float:
    """Return the part of a view that is new, by its correlation with the view before."""
    return (1.0 - same) / (1.0 + same)


class Filter:
    """Estimates the robot's place from frame to frame.

    Parameters
    ----------
    visual_map : VisualMap
    centering : Centering
        Centering of the features.
    seed : int
        Seed of the particles' noise. Equal frames and movements give an equal belief.
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
        self._spacing = visual_map.correlation_length / visual_map.config.views_a_length
        # Cached properties are computed here, so that the first frame does not wait.
        _ = visual_map.neighbour_cosines, visual_map.sample, visual_map.overview
        _ = visual_map.repeated(0.0)
        self.reset()

    def reset(self, belief: Belief | None = None, seed: int | None = None) -> None:
        """Start a new episode.

        Parameters
        ----------
        belief : Belief, optional
            Belief to start from (a summary is enough). By default the robot starts at the beginning of a drive.
        seed : int, optional
            Seed of this and the following episodes; by default as before.
        """
        if seed is not None:
            self._seed = seed
        self._rng = np.random.default_rng(self._seed)
        self._tracked = self._at_starts()
        self._jumped: Particles | None = None
        at_start, anywhere, lost = self._config.first
        away = lost * anywhere / (anywhere + lost)
        self._odds = _Odds(at_start, 0.0, anywhere, 0.0, away, lost - away)
        self._frozen = Frozen(self._map)
        self.forget_view()
        self._started = False
        self._unseen = 0.0
        self._support = 0.0
        self._camera: CameraState = "sees"
        #: Drive and pose of the last certain position, moved on by the odometry, and its error.
        self._sure: tuple[int, Floats, float] | None = None
        if belief is not None:
            self._tracked = self._drawn_from(belief)
            self._odds = _Odds(1.0 - belief.lost, 0.0, 0.0, 0.0, 0.0, belief.lost)
            self._support = belief.support
            self._started = True

    def forget_view(self) -> None:
        """Forget the views before: the next one is entirely new, and neither confirms nor denies a jump."""
        self._newness = Newness(self._map)
        self._directions = SeenDirections(self._map)
        #: Components of the last new view, and the step since then.
        self._last = np.zeros(self._map.basis.shape[1], dtype=np.float32)
        self._since = np.zeros(3)

    def _at_starts(self) -> Particles:
        """Scatter particles about the first keyframes of all drives."""
        starts = np.unique(self._map.key_range[0])
        keyframes = self._rng.choice(starts, self._config.particles)
        aside = max(self._map.aside, self._config.start_s * self._map.speed)
        straight = np.zeros(keyframes.size)
        return self._beside(keyframes, straight, aside, 180.0)

    def _drawn_from(self, belief: Belief) -> Particles:
        """Scatter particles about the places of a belief, by their weights."""
        which = systematic(belief.weights, self._config.particles, self._rng)
        keyframes = belief.keyframes[which]
        straight = np.zeros(which.size)
        particles = self._beside(keyframes, straight, self._spacing / 2.0, STEP_DEG / 2.0)
        key_poses = self._map.key_poses[keyframes]
        particles.poses += placed(belief.offsets[which], key_poses) - key_poses
        particles.tracked += belief.tracked
        return particles

    def observe(
        self,
        raw_features: AnyArray,
        movement: Movement = STILL,
        noise: MotionNoise = BY_ODOMETRY,
    ) -> Belief:
        """Update the belief by one frame.

        Parameters
        ----------
        raw_features : array (m,)
            From `smal.features.extract`.
        movement : Movement
            Movement since the frame before; ignored for the first frame.
        noise : MotionNoise
            Noise of the movement.

        Raises
        ------
        ValueError
            If the features have the wrong length, or the features or the movement are not finite. The frame is ignored.
        """
        if raw_features.ndim != 1:
            raise ValueError(
                f"invalid features: shape {raw_features.shape}; pass those of one frame, (m,)"
            )
        if not (math.isfinite(movement.ahead) and math.isfinite(movement.turn_rad)):
            raise ValueError(
                f"a movement must be finite, got {movement.ahead} ahead and a turn of {movement.turn_rad}"
            )
        centred = self._centering.apply(raw_features)
        step = np.array([movement.ahead, 0.0, movement.turn_rad])
        if self._started:
            self._since = placed(step, self._since)
        self._newness.move(step)
        self._directions.move(step)
        self._frozen.observe(centred, step if self._started else np.zeros(3))
        seen = self._seen(centred)
        if self._started:
            self._jump(seen, movement, noise)
            self._move(movement, noise, seen.newness)
            self._turn_in(abs(movement.turn_rad))
            if self._sure is not None:
                drive, pose, reach = self._sure
                reach += self._config.slip * abs(movement.ahead)
                self._sure = drive, placed(step, pose), reach
        # A probability of 0 never recovers.
        tracked = max(self._odds.tracked, 1e-12)
        self._odds = self._odds._replace(tracked=tracked)
        self._started = True
        self._evidence = 0.0
        if seen.newness > 0.0:
            self._last = seen.components
            self._since = np.zeros(3)
            self._weigh(seen)
            certain = min(self._directions.new() / seen.newness, 1.0)
            share = 1.0 if self._evidence < 0.0 else certain
            self._support = max(self._support + share * self._evidence, 0.0)
            self._note_sure()
        if self._odds.unknown > 0.5:
            self._support = 0.0
            self._directions = SeenDirections(self._map)
        self._note_seen(seen, abs(movement.ahead))
        return self._belief(seen)

    def _seen(self, centred: Float32s) -> ViewEvidence:
        """Compare a view with the views of the map.

        A view carries no information if it is clearly most like a blank picture, equally like all places,
        bit-identical to the last view, or unchanged while the wheels move.
        """
        components = self._map.described(centred)
        keyframes, stand_for = self._map.likely(components)
        cosines = self._map.ahead_cosines(components, keyframes)
        middle, spread = scale(self._map.sample @ components)
        like_blank = float(components @ self._map.blank)
        empty = not components.any()
        # An overexposed view resembles both: a blank picture has to explain twice as much of its variance.
        blank = empty or spread <= 1e-6 or like_blank > math.sqrt(2.0) * max(cosines.max(), 0.0)
        # A view of an untaught scene can be less like each taught view than like a blank picture.
        dead = blank and (like_blank > 0.5 or empty)
        self._camera = "blank" if dead else "frozen" if self._frozen.yes else "sees"
        evidence = ViewEvidence(components, keyframes, stand_for, cosines, middle, 0.0, 0.0)
        if blank or self._frozen.yes or np.array_equal(components, self._last):
            return evidence
        return evidence._replace(spread=spread, newness=self._newness.of(centred))

    def _jump(self, seen: ViewEvidence, movement: Movement, noise: MotionNoise) -> None:
        """Move probability from the tracked particles to scouts and to "lost".

        Every new view moves a little. A view that differs from the view before, though the robot has hardly
        moved, moves much; a view that continues the view before moves nearly nothing. Without views,
        confidence in the odometry decays.
        """
        odds = self._odds
        if seen.spread == 0.0:
            kept = 0.5 ** (self._map.lengths(movement) / self._config.blind)
            strayed = (1.0 - kept) * (odds.tracked + odds.jumped)
            self._odds = odds._replace(
                tracked=kept * odds.tracked, jumped=kept * odds.jumped, lost=odds.lost + strayed
            )
            return
        jump = self._jump_probability(seen, noise.jump)
        _, anywhere, nowhere = self._config.first
        out = nowhere / (anywhere + nowhere)
        back = self._config.back * seen.newness
        gone = (odds.tracked + odds.jumped) * jump
        self._odds = odds._replace(
            tracked=odds.tracked * (1.0 - jump),
            jumped=odds.jumped * (1.0 - jump),
            sent=odds.sent + gone * (1.0 - out) + odds.unknown * back,
            away=odds.away * (1.0 - back),
            lost=odds.lost * (1.0 - back) + gone * out,
        )

    def _turn_in(self, turn_rad: float) -> None:
        """Move probability from "away": a turn brings some of its headings before taught views."""
        turned = self._odds.away * min(turn_rad / (math.tau * (1.0 - _FACING)), 1.0)
        turned_in = self._odds.turned_in + turned
        self._odds = self._odds._replace(turned_in=turned_in, away=self._odds.away - turned)

    def _jump_probability(self, seen: ViewEvidence, usual: float) -> float:
        """Return the probability of a jump, given how much the view differs from the view before.

        `usual` is the probability without this difference, for a view that is entirely new. If two views
        differ, either the robot has jumped, or something hides the place in one of them.
        """
        if not self._last.any():
            return usual * seen.newness
        z = seen.stands_out(seen.components @ self._last)
        like_last = float(self._map.likelihood.of(z))
        visible = 1.0 - float(self._tracked.shares[0])
        surprise = -self._map.expected(self._since) * like_last
        rise = visible * math.expm1(surprise)
        hides = self._config.hides(self._map.config.hidden)
        either = (usual + hides) * seen.newness * rise
        return usual * seen.newness * (1.0 + rise) / (1.0 + either)

    def _move(self, movement: Movement, noise: MotionNoise, newness: float) -> None:
        """Predict; particles that leave the taught area become "lost"."""
        tracked = self._odds.tracked
        jumped = self._odds.jumped
        strayed = tracked * self._tracked.move(movement, noise, newness, self._rng)
        others = 0.0
        if self._jumped is not None:
            others = jumped * self._jumped.move(movement, noise, newness, self._rng)
        self._odds = self._odds._replace(
            tracked=tracked - strayed,
            jumped=jumped - others,
            lost=self._odds.lost + strayed + others,
        )

    def _weigh(self, seen: ViewEvidence) -> None:
        """Weigh all particles by a view, and send scouts."""
        tracked = self._odds.tracked
        jumped = self._odds.jumped
        # Scouts take the shares from before this view: a view unlike the tracked place gives no evidence on others.
        shares = self._tracked.shares
        tracked *= self._tracked.update(seen, self._rng)
        if self._jumped is not None:
            jumped *= self._jumped.update(seen, self._rng)
        scouts, sent = self._scouts(seen, shares)
        if self._jumped is not None:
            scouts = Particles.joined((self._jumped, jumped), (scouts, sent))
            scouts.resampled(self._rng)
        self._jumped = scouts
        jumped = jumped + sent
        if jumped > tracked:
            self._tracked = Particles.joined((self._tracked, tracked), (scouts, jumped))
            self._tracked.resampled(self._rng)
            self._jumped = None
            tracked = tracked + jumped
            jumped = 0.0
        away = self._odds.away
        lost = self._odds.lost
        total = tracked + jumped + away + lost
        self._odds = _Odds(tracked / total, jumped / total, 0.0, 0.0, away / total, lost / total)
        self._evidence = math.log(total)

    def _looks_at_taught(self) -> float:
        """Return how far the tracked robot looks at taught views, 0 to 1."""
        return float(self._tracked.weights @ self._tracked.facing())

    def _scouts(self, seen: ViewEvidence, shares: Floats) -> tuple[Particles, float]:
        """Draw particles by the likelihood of one view; also return their joint probability with the view."""
        z = seen.stands_out(seen.cosines)
        whole = self._map.likelihood.mixed(shares, z, 1.0)
        new = self._map.likelihood.mixed(shares, z, seen.newness)
        prior = self._scout_prior(seen)[:, None]
        weights = prior * whole
        joint = prior * (self._odds.sent * new + self._odds.turned_in * whole)
        drawn = systematic(weights.ravel(), self._config.particles, self._rng)
        chosen, turns = np.divmod(drawn, TURNS_DEG.size)
        scouts = self._beside(
            seen.keyframes[chosen],
            np.radians(TURNS_DEG[turns]),
            self._map.aside,
            STEP_DEG / 2.0,
        )
        # They are drawn by the whole view, also those to which only a part is new.
        correction = (joint / weights).ravel()[drawn]
        scouts.weights = correction / correction.sum()
        scouts.shares = shares
        # The pace belongs to the robot, wherever it is.
        weights = self._tracked.weights
        scouts.pace = self._rng.choice(self._tracked.pace, drawn.size, p=weights / weights.sum())
        return scouts, float(joint.sum())

    def _scout_prior(self, seen: ViewEvidence) -> Floats:
        """Return the prior of the keyframes (n,): a share near the last certain pose, the rest even."""
        prior: Floats = seen.stand_for / (seen.stand_for.sum() * TURNS_DEG.size)
        if self._sure is None:
            return prior
        drive, pose, reach = self._sure
        apart = self._map.key_poses[:, :2] - pose[:2]
        distance = np.hypot(*apart.T) / reach
        near = np.exp(-0.5 * np.square(distance)) * (self._map.key_drives == drive)
        near = near[seen.keyframes] / max(float(near.sum()), 1e-12)
        share = self._config.near
        return np.asarray((1.0 - share) * prior + share * near / TURNS_DEG.size)

    def _beside(
        self,
        keyframes: Indices,
        turns: Floats,
        aside: float,
        turned_deg: float,
    ) -> Particles:
        """Scatter particles about keyframes."""
        spread = np.array([aside, aside, math.radians(turned_deg)])
        scatter = self._rng.uniform(-1.0, 1.0, (len(keyframes), 3))
        poses = self._map.key_poses[keyframes] + scatter * spread
        poses[:, 2] += turns
        particles = Particles(self._map, keyframes, poses, self._config)
        particles.pace = self._rng.standard_normal(len(poses))
        return particles

    def _note_sure(self) -> None:
        """Store the pose if it is certain: one place on one drive."""
        tracked = self._tracked
        drives = self._map.key_drives[tracked.keyframes]
        drive = int(drives[tracked.weights.argmax()])
        weights = tracked.weights * (drives == drive)
        share = float(weights.sum())
        x, y, _ = weights @ tracked.poses / max(share, 1e-12)
        headings = tracked.poses[:, 2]
        heading = math.atan2(weights @ np.sin(headings), weights @ np.cos(headings))
        pose = np.array([x, y, heading])
        apart = (tracked.poses - pose)[:, :2]
        variance = float(weights @ (apart**2).sum(axis=1))
        likely = self._odds.tracked * share > self._config.located
        spread = math.sqrt(variance)
        if likely and spread < self._map.correlation_length:
            self._sure = (drive, pose, max(spread, self._spacing))

    def _note_seen(self, seen: ViewEvidence, way: float) -> None:
        """Add up the way since a view last supported the tracked place; a robot that looks away adds less."""
        self._unseen = max(self._unseen + way * self._looks_at_taught(), self._frozen.way)
        if seen.spread > 0.0 and self._tracked.speaks > 1.0:
            self._unseen = 0.0

    def _belief(self, seen: ViewEvidence) -> Belief:
        tracked = self._odds.tracked
        jumped = self._odds.jumped
        others = [] if self._jumped is None else [(self._jumped, jumped)]
        every = Particles.joined((self._tracked, tracked), *others)
        # A tenth of the weight has been followed for less.
        order = np.argsort(every.tracked)
        shares = np.cumsum(every.weights[order])
        least = min(int(np.searchsorted(shares, 0.1)), order.size - 1)
        return Belief(
            keyframes=every.keyframes,
            offsets=every.offsets(),
            weights=every.weights,
            lost=self._odds.unknown / sum(self._odds),
            cosine=min(every.cosine(seen), 1.0),
            tracked=float(every.tracked[order[least]]),
            evidence=self._evidence,
            unseen=self._unseen,
            camera=self._camera,
            support=self._support,
        )

"""Where the robot is: a Bayes filter over taught places, the robot's offset there, and "lost".

The hidden state is a pose beside a taught keyframe: which keyframe, how far ahead and to the left of it, and how far
turned; or that the robot is nowhere near what was taught. A particle filter (Gordon, Salmond and Smith 1993; Thrun,
Burgard and Fox 2005, chapters 4 and 8) keeps it:

* *Prediction* moves every particle by what the wheels say (or by what the atom usually does), with noise.
* *Update* weighs it by how alike the view is to the virtual views of its keyframe (`smal.visual_map`): kappa times what
  the cosine exceeds that of an outlier, which is what the view has with places that look unlike the best one. So the
  likelihood of "lost" is 1, and whether the robot is lost is a matter of probability and not of a threshold.
* A view is as much evidence as it is new: of a robot that stands still, the same view ten times is one view. New is
  what lies a keyframe's distance further, so that neither frame rate nor speed enters.
* A second set of particles, the scouts, are drawn from everywhere by what a single view says. Both sets are then
  weighed by the views that follow. The scouts start with the low probability of a kidnapping, and replace particles of
  the first set in proportion to what they gain. They find a robot that is switched on anywhere, and one that was
  kidnapped.

The paper instead matches the last l frames anew at every decision (Eq. 7 and 9, `smal.paper.recognition`). That has no
memory, so that alikeness longer than l frames cannot be resolved.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from smal.features import Centering
from smal.movement import BY_ODOMETRY, STILL, MotionNoise, Movement, seen_from, wrapped
from smal.settings import SETTINGS
from smal.virtual_views import TURNS_DEG
from smal.visual_map import VisualMap


@dataclass(frozen=True, eq=False)
class Belief:
    """Where the robot may be.

    Parameters
    ----------
    keyframes : int array (p,)
        Keyframe that each particle is beside.
    offsets : float64 array (p, 3)
        How far ahead and to the left of it, in the map's unit, and turned left, radians.
    weights : float64 array (p,)
        Probabilities given that the robot is not lost; they sum to 1.
    lost : float
        Probability, 0 to 1, that the robot is nowhere near what was taught.
    cosine : float
        Mean cosine of the last view with the views of these places.
    tracked : float
        Mean way that the particles have been followed for since they were drawn as scouts, in the map's unit; a turn
        counts as the way that changes the view as much.
    """

    keyframes: NDArray[np.intp]
    offsets: NDArray[np.float64]
    weights: NDArray[np.float64]
    lost: float
    cosine: float
    tracked: float

    def summary(self, most: int = SETTINGS.places) -> "Belief":
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
        return Belief(keys[order], mean[order], kept, self.lost, self.cosine, self.tracked)


class _Particles:
    """Poses in the axes of the drive of their keyframe, and weights that sum to 1."""

    def __init__(self, visual_map: VisualMap, keyframes: NDArray[np.intp], poses: NDArray[np.float64]) -> None:
        self._map = visual_map
        self.keyframes, self.poses = keyframes, poses
        self.followed = np.zeros(len(poses))
        self.weights = np.full(len(poses), 1.0 / len(poses))
        self.cosine = 0.0
        self.evidence = 0.0

    def move(self, movement: Movement, noise: MotionNoise, newness: float, rng: np.random.Generator) -> None:
        """Predict: move all by a movement with noise, and find their keyframes."""
        ahead_noise, turn_noise, drift, jitter = rng.standard_normal((4, len(self.poses)))
        ahead = movement.ahead * (1.0 + noise.ahead * ahead_noise)
        way = math.sqrt(abs(movement.ahead) / self._map.correlation_length)
        turn = movement.turn_rad * (1.0 + noise.turn * turn_noise)
        turn += noise.drift_rad * way * drift + noise.jitter_rad * newness * jitter
        middle = self.poses[:, 2] + turn / 2.0
        self.poses += np.stack([ahead * np.cos(middle), ahead * np.sin(middle), turn], axis=1)
        self.followed += self._map.lengths(movement) * self._map.correlation_length
        first, last = (edge[self.keyframes][:, None] for edge in self._map.key_range)
        near = np.clip(self.keyframes[:, None] + np.arange(-SETTINGS.neighbours, SETTINGS.neighbours + 1), first, last)
        apart = self.poses[:, None] - self._map.key_poses[near]
        far = (apart[..., 0] ** 2 + apart[..., 1] ** 2) / self._map.correlation_length**2
        # A turn is covered by the virtual views: it counts for less than the place.
        far += (wrapped(apart[..., 2]) / (3.0 * self._map.correlation_rad)) ** 2
        self.keyframes = np.take_along_axis(near, far.argmin(axis=1)[:, None], axis=1)[:, 0]

    def offsets(self) -> NDArray[np.float64]:
        """Return poses as seen from their keyframes: ahead, left, turned (p, 3)."""
        return seen_from(self.poses, self._map.key_poses[self.keyframes])

    def update(self, cosines: NDArray[np.float32], outlier: float, newness: float, rng: np.random.Generator) -> float:
        """Weigh by a view; return the logarithm of its probability here.

        Cosines (k, 3, turns) are those of the frame with each view of the map; the outlier's is that of a frame which
        shows no place of it; of the view a share of 0 to 1 is new.
        """
        found, beyond = self._interpolated(cosines)
        self.cosine = float(self.weights @ found)
        likelihood = _likelihood(self._map.kappa, found - outlier, beyond) ** newness
        weights = self.weights * likelihood
        total = float(weights.sum())
        self.weights = weights / total
        self.evidence += newness
        if (self.weights**2).sum() > 2.0 / len(self.weights):
            self.keep(_systematic(self.weights, len(self.weights), rng))
        return math.log(total)

    def _interpolated(self, cosines: NDArray[np.float32]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the cosine with the view at each particle's offset, and how far that lies beyond the virtual views.

        Between two views the one between them is their sum, scaled to unit length; beyond the outermost ones it is
        in correlation lengths.
        """
        offsets = self.offsets()
        by_turn, by_place = self._map.neighbour_cosines
        k = self.keyframes
        step = float(TURNS_DEG[1] - TURNS_DEG[0])
        turned = (np.degrees(offsets[:, 2]) - TURNS_DEG[0]) / step
        inside = np.clip(turned, 0.0, TURNS_DEG.size - 1)
        t = np.minimum(inside.astype(np.intp), TURNS_DEG.size - 2)
        f = inside - t
        aside = np.clip(offsets[:, 1] / self._map.aside, -1.0, 1.0) + 1.0
        p = np.minimum(aside.astype(np.intp), 1)
        g = aside - p

        def at(place: NDArray[np.intp]) -> NDArray[np.float64]:
            mixed = (1.0 - f) * cosines[k, place, t] + f * cosines[k, place, t + 1]
            scaled: NDArray[np.float64] = mixed / _norm(f, by_turn[k, place, t])
            return scaled

        places_alike = (1.0 - f) * by_place[k, p, t] + f * by_place[k, p, t + 1]
        found = ((1.0 - g) * at(p) + g * at(p + 1)) / _norm(g, places_alike)
        length = self._map.correlation_length
        beyond = np.hypot(
            np.maximum(np.abs(offsets[:, 1]) - self._map.aside, 0.0) / self._map.aside,
            np.maximum(np.abs(offsets[:, 0]) - 0.5 * length, 0.0) / length,
        )
        turned_beyond = np.maximum(np.abs(turned - (TURNS_DEG.size - 1) / 2.0) - (TURNS_DEG.size / 2.0), 0.0)
        return found, np.hypot(beyond, turned_beyond * math.radians(step) / self._map.correlation_rad)

    def keep(self, which: NDArray[np.intp]) -> None:
        """Keep some particles, alike in weight."""
        self.keyframes, self.poses, self.followed = self.keyframes[which], self.poses[which], self.followed[which]
        self.weights = np.full(which.size, 1.0 / which.size)


def _likelihood(kappa: float, above: NDArray[Any], beyond: NDArray[Any] | float = 0.0) -> NDArray[np.float64]:
    """Return p(view | particle) / p(view | lost).

    `above` is its cosine minus the outlier's, `beyond` how far outside of the virtual views it lies, in correlation
    lengths.
    """
    evidence = kappa * above - 2.0 * np.square(beyond)
    return np.asarray((1.0 - SETTINGS.hidden) * np.exp(evidence) + SETTINGS.hidden, dtype=np.float64)


def _norm(share: NDArray[np.float64], cosine: NDArray[Any]) -> NDArray[np.float64]:
    """Return the length of a mixture of two unit vectors, of which the second has this share.

    Views beside each other are never opposite; a damaged map must not divide by zero.
    """
    squared = (1.0 - share) ** 2 + share**2 + 2.0 * share * (1.0 - share) * np.maximum(cosine, -0.5)
    length: NDArray[np.float64] = np.sqrt(squared)
    return length


def _systematic(weights: NDArray[Any], count: int, rng: np.random.Generator) -> NDArray[np.intp]:
    edges = np.cumsum(weights, dtype=np.float64)
    marks = (rng.random() + np.arange(count)) / max(count, 1) * edges[-1]
    found: NDArray[np.intp] = np.minimum(np.searchsorted(edges, marks), len(weights) - 1)
    return found


class Filter:
    """Follows the robot from frame to frame.

    Parameters
    ----------
    visual_map : VisualMap
    centering : Centering
        Of the features.
    seed : int
        Of the particles' noise: the same frames and movements give the same belief.
    """

    def __init__(self, visual_map: VisualMap, centering: Centering, seed: int = 0) -> None:
        self._map = visual_map
        self._centering = centering
        self._seed = seed
        # Made here, and not while the first frame waits.
        _ = visual_map.unlike, visual_map.neighbour_cosines
        self.reset()

    def reset(self) -> None:
        """Forget everything, for a new episode."""
        self._rng = np.random.default_rng(self._seed)
        self._tracked: _Particles | None = None
        self._scouts: _Particles | None = None
        # Log probabilities that the tracked particles, the scouts, or neither are right.
        self._odds = np.log(SETTINGS.first)
        self._waited_s = 0.0

    def observe(
        self,
        raw_features: NDArray[Any],
        movement: Movement = STILL,
        elapsed_s: float | None = None,
        noise: MotionNoise = BY_ODOMETRY,
    ) -> Belief:
        """Take one frame.

        Parameters
        ----------
        raw_features : array (m,)
            From `smal.features.extract`.
        movement : Movement
            Since the frame before; that before the first frame does not count.
        elapsed_s : float, optional
            Time since the frame before; a taught tick if not given.
        noise : MotionNoise
            Of the movement.

        Raises
        ------
        ValueError
            Features of the wrong length, or features, a movement or a time that are NaN, infinite or backwards; the
            frame is then not taken in.
        """
        if raw_features.ndim != 1:
            raise ValueError(f"the features of one frame are wanted, got the shape {raw_features.shape}")
        elapsed_s = self._map.tick_s if elapsed_s is None else elapsed_s
        if not (math.isfinite(movement.ahead) and math.isfinite(movement.turn_rad)):
            raise ValueError(f"a movement must be finite, got {movement.ahead} ahead and a turn of {movement.turn_rad}")
        if not (math.isfinite(elapsed_s) and elapsed_s >= 0.0):
            raise ValueError(f"the time since the frame before must be finite and not negative, got {elapsed_s}")
        cosines = self._map.cosines(self._centering.apply(raw_features))
        if self._tracked is None:
            self._tracked, newness = self._at_starts(), 1.0
        else:
            newness = min(1.0, SETTINGS.views_a_length * self._map.lengths(movement))
            for particles in (self._tracked, self._scouts):
                if particles is not None:
                    particles.move(movement, noise, newness, self._rng)
        self._waited_s += elapsed_s
        self._weigh(self._tracked, cosines, newness)
        # While the robot stands still, no view can contradict the leak.
        if newness > 0.0:
            self._leak(elapsed_s)
        if self._scouts is not None and self._scouts.evidence >= SETTINGS.trial:
            self._merge()
        return self._belief()

    def _weigh(self, tracked: _Particles, cosines: NDArray[np.float32], newness: float) -> None:
        outlier = self._map.outlier_of(cosines)
        self._odds[0] += tracked.update(cosines, outlier, newness, self._rng)
        if self._scouts is None:
            self._send_scouts(cosines, outlier, newness)
        else:
            self._odds[1] += self._scouts.update(cosines, outlier, newness, self._rng)

    def _at_starts(self) -> _Particles:
        starts = np.unique(self._map.key_range[0])
        keyframes = self._rng.choice(starts, SETTINGS.particles)
        return self._beside(keyframes, np.zeros(SETTINGS.particles), math.radians(SETTINGS.first_turn_deg))

    def _beside(self, keyframes: NDArray[np.intp], turns: NDArray[np.float64], spread_rad: float) -> _Particles:
        """Scatter particles about keyframes, as far as virtual views reach."""
        spread = np.array([self._map.aside, self._map.aside, spread_rad])
        poses = self._map.key_poses[keyframes] + self._rng.uniform(-1.0, 1.0, (len(keyframes), 3)) * spread
        poses[:, 2] += turns
        return _Particles(self._map, keyframes, poses)

    def _send_scouts(self, cosines: NDArray[np.float32], outlier: float, newness: float) -> None:
        """Draw particles from everywhere by one view, which counts for them as much as for those that are tracked."""
        likelihood = _likelihood(self._map.kappa, cosines[:, 1] - outlier)
        keyframes, turns = np.divmod(_systematic(likelihood.ravel(), SETTINGS.particles, self._rng), TURNS_DEG.size)
        half = math.radians(float(TURNS_DEG[1] - TURNS_DEG[0])) / 2.0
        self._scouts = self._beside(keyframes, np.radians(TURNS_DEG[turns]), half)
        self._odds[1] += math.log(float((likelihood**newness).mean()))

    def _leak(self, elapsed_s: float) -> None:
        """Let a little of what is known become lost."""
        shares = _normalized(self._odds)
        leaked = shares[:2] * _carried_away(elapsed_s)
        shares[:2] -= leaked
        shares[2] += leaked.sum()
        self._odds = np.log(np.maximum(shares, 1e-12))

    def _merge(self) -> None:
        """Give the scouts the part of the particles that they have earned.

        The odds of the next ones are those of having been carried away since, or being back beside the way.
        """
        old, scouts = self._tracked, self._scouts
        assert old is not None
        assert scouts is not None
        shares = _normalized(self._odds)
        new = round(SETTINGS.particles * float(shares[1] / max(shares[0] + shares[1], 1e-12)))
        if new:
            kept = _systematic(old.weights, SETTINGS.particles - new, self._rng)
            taken = _systematic(scouts.weights, new, self._rng)
            self._tracked = _Particles(
                self._map,
                np.concatenate([old.keyframes[kept], scouts.keyframes[taken]]),
                np.concatenate([old.poses[kept], scouts.poses[taken]]),
            )
            self._tracked.followed = np.concatenate([old.followed[kept], scouts.followed[taken]])
            self._tracked.cosine = scouts.cosine if 2 * new > SETTINGS.particles else old.cosine
        tracked, lost = shares[0] + shares[1], shares[2]
        carried, back = tracked * _carried_away(self._waited_s), SETTINGS.back * lost
        self._odds = np.log(np.maximum([tracked - carried, carried + back, lost - back], 1e-12))
        self._waited_s = 0.0
        self._scouts = None

    def _belief(self) -> Belief:
        assert self._tracked is not None
        shares = _normalized(self._odds)
        sets = [(self._tracked, float(shares[0])), (self._scouts, float(shares[1]))]
        present = [(particles, share) for particles, share in sets if particles is not None]
        total = sum(share for _, share in present)
        return Belief(
            np.concatenate([particles.keyframes for particles, _ in present]),
            np.concatenate([particles.offsets() for particles, _ in present]),
            np.concatenate([particles.weights * (share / total) for particles, share in present]),
            float(shares[2]),
            sum(particles.cosine * share for particles, share in present) / total,
            sum(float(particles.weights @ particles.followed) * share for particles, share in present) / total,
        )


def _carried_away(elapsed_s: float) -> float:
    """Return the probability of having been carried away in so many seconds: below 1 however long they are."""
    return -math.expm1(-elapsed_s / SETTINGS.kidnap_s)


def _normalized(log_odds: NDArray[np.float64]) -> NDArray[np.float64]:
    shares = np.exp(log_odds - log_odds.max())
    normalized: NDArray[np.float64] = shares / shares.sum()
    return normalized

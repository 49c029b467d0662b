"""Weighted particles: poses beside taught keyframes and their probabilities."""

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Final, NamedTuple, Self

import numpy as np

from smal.arrays import AnyArray, Float32s, Floats, Indices
from smal.camera import STEP_DEG, TURNS_DEG
from smal.likelihood import ANY_DAY, SHARES, over
from smal.map import VisualMap
from smal.movement import MotionNoise, Movement, seen_from, wrapped


@dataclass(frozen=True)
class FilterConfig:
    """Parameters of the filter; lengths are in correlation lengths of the map."""

    #: Particles of each set. More take longer without a better estimate.
    particles: int = 1000
    #: Initial probabilities: at the start of a taught drive, beside any way, lost.
    first: tuple[float, float, float] = (0.5, 0.35, 0.15)
    #: Scatter of the start, as time of driving.
    start_s: float = 0.5
    #: Probability, for each new view, that a lost robot is back beside the way.
    back: float = 0.05
    #: Probability, for each new view, that a hidden place is visible again.
    appears: float = 0.5
    #: Probability, for each new view, that the light changes. A light lasts for about fifty new views.
    light: float = 0.02
    #: Scatter of the heading at every new view: cameras shake.
    jitter_deg: float = 1.0
    #: Way without a view after which the odometry has half its confidence.
    blind: float = 2.0
    #: Probability from which scouts are drawn near a place after a jump.
    located: float = 0.9
    #: Share of the scouts that are drawn there; the others are drawn everywhere.
    near: float = 0.5
    #: Error of the odometry since then, as a share of the way.
    slip: float = 0.1

    def hides(self, hidden: float) -> float:
        """Return the probability that something hides the next new view, for a long-term share `hidden`."""
        return self.appears * hidden / (1.0 - hidden)


FILTER_CONFIG: Final = FilterConfig()


@lru_cache(maxsize=8)
def share_changes(config: FilterConfig, hidden: float) -> Floats:
    """Return the transition matrix of the visible share with a new view, (from, to)."""
    hides = config.hides(hidden)
    stays = 1.0 - hides - config.light
    rows = stays * np.eye(SHARES.size) + config.light * ANY_DAY
    rows[:, 0] += hides
    rows[0] = config.appears * ANY_DAY
    rows[0, 0] = 1.0 - config.appears
    return rows


class ViewEvidence(NamedTuple):
    """Comparison of one view with n keyframes of the map."""

    #: (r,) components of the view (`VisualMap.described`).
    components: Float32s
    keyframes: Indices
    #: Number of keyframes that each of these represents.
    stand_for: Floats
    #: (n, turns) cosines with the views of the keyframes.
    cosines: Float32s
    #: Median and spread of the cosines with the sample of elsewhere.
    middle: float
    spread: float
    #: Share of the view that earlier views did not contain, 0 to 1.
    newness: float

    def stands_out(self, cosines: AnyArray) -> AnyArray:
        """Return the z values of cosines."""
        return over(cosines, self.middle, self.spread)


class Particles:
    """Poses in the axes of the drive of their keyframe, with weights that sum to 1."""

    def __init__(
        self,
        visual_map: VisualMap,
        keyframes: Indices,
        poses: Floats,
        config: FilterConfig = FILTER_CONFIG,
    ) -> None:
        self._map = visual_map
        self._config = config
        self.keyframes = keyframes
        self.poses = poses
        count = len(poses)
        self.tracked = np.zeros(count)
        self.weights = np.full(count, 1.0 / count)
        #: Standard deviations by which the robot is faster than reported.
        self.pace = np.zeros(count)
        #: Probability of each visible share (`smal.likelihood.SHARES`) in the next view.
        hidden = visual_map.config.hidden
        self.shares = (1.0 - hidden) * ANY_DAY + hidden * (SHARES == 0.0)
        #: Likelihood ratio of the last view here to elsewhere, if all of it was new and nothing hid the place.
        self.speaks = 1.0

    def move(
        self, movement: Movement, noise: MotionNoise, newness: float, rng: np.random.Generator
    ) -> float:
        """Predict: move all particles by a movement with noise, and assign their nearest keyframes.

        Returns
        -------
        float
            Share of the weight that left the taught area. These particles keep only a trace of their weight.
        """
        self._drive(movement, noise, newness, rng)
        self.tracked += abs(movement.ahead)
        self.keyframes = self._nearest_keyframes()
        apart = (self.poses - self._map.key_poses[self.keyframes])[:, :2]
        reach = self._map.config.elsewhere * self._map.correlation_length
        away = np.hypot(*apart.T) > reach
        strayed = min(float(self.weights[away].sum()), 1.0 - 1e-6)
        self.weights[away] *= 1e-6
        self.weights /= self.weights.sum()
        return strayed

    def _drive(
        self, movement: Movement, noise: MotionNoise, newness: float, rng: np.random.Generator
    ) -> None:
        """Move the poses by a movement with noise.

        Momentary errors are a diffusion: they grow with the square root of the way, independently of speed and frame
        rate. A wheel of wrong size, or a driver in haste, changes the pace for longer.
        """
        normal = rng.standard_normal((4, len(self.poses)))
        ahead_noise, turn_noise, heading_noise, pace_noise = normal
        length = self._map.correlation_length
        lengths = abs(movement.ahead) / length
        root = math.sqrt(lengths)
        kept = math.exp(-lengths / noise.pace_lengths)
        self.pace = kept * self.pace + math.sqrt(1.0 - kept**2) * pace_noise
        pace = np.exp(noise.pace * self.pace)
        ahead = movement.ahead * pace + noise.ahead * root * length * ahead_noise
        jitter_deg = self._config.jitter_deg * math.sqrt(newness)
        drift_deg = math.hypot(noise.drift_deg * root, jitter_deg)
        turn = movement.turn_rad * pace + math.radians(drift_deg) * heading_noise
        turn += noise.turn * math.sqrt(abs(movement.turn_rad)) * turn_noise
        middle = self.poses[:, 2] + turn / 2.0
        x = ahead * np.cos(middle)
        y = ahead * np.sin(middle)
        self.poses += np.stack([x, y, turn], axis=1)

    def _nearest_keyframes(self) -> Indices:
        """Return the keyframe nearest to each particle, among the neighbours of its last one, (p,)."""
        first, last = (edge[self.keyframes][:, None] for edge in self._map.key_range)
        reach = self._map.config.neighbours
        neighbours = np.arange(-reach, reach + 1)
        near = np.clip(self.keyframes[:, None] + neighbours, first, last)
        apart = self.poses[:, None] - self._map.key_poses[near]
        squared = apart[..., 0] ** 2 + apart[..., 1] ** 2
        cost = squared / self._map.correlation_length**2
        # Virtual views cover turns: a turn costs less than a way.
        cost += (wrapped(apart[..., 2]) / (3.0 * self._map.apart_rad)) ** 2
        nearest = cost.argmin(axis=1)[:, None]
        return np.take_along_axis(near, nearest, axis=1)[:, 0]

    def offsets(self) -> Floats:
        """Return the poses relative to their keyframes: ahead, left, turned (p, 3)."""
        return seen_from(self.poses, self._map.key_poses[self.keyframes])

    def update(self, seen: ViewEvidence, rng: np.random.Generator) -> float:
        """Weigh by a view; return its mean likelihood ratio here to elsewhere."""
        found, beyond = self.interpolated(seen.components)
        z = seen.stands_out(found)
        likelihood = self._map.likelihood
        log_ratio = np.stack([likelihood.of(z, share) for share in range(SHARES.size)])
        # Far aside of the views is like elsewhere. A robot that looks away from all taught views gets no evidence.
        aside = log_ratio[1:] - 2.0 * np.square(beyond)
        log_ratio[1:] = np.maximum(aside, likelihood.log_ratio[1:, :1])
        log_ratio *= self.facing()
        shown = self.shares[1:] / self.shares[1:].sum()
        self.speaks = float(shown @ np.exp(log_ratio[1:]) @ self.weights)
        joint = self.shares[:, None] * np.exp(seen.newness * log_ratio) * self.weights
        total = float(joint.sum())
        self.weights = joint.sum(axis=0) / total
        shares = joint.sum(axis=1) / total
        changes = share_changes(self._config, self._map.config.hidden)
        self.shares = shares + (shares @ changes - shares) * seen.newness
        concentration = (self.weights**2).sum()
        if concentration > 2.0 / len(self.weights):
            self.resampled(rng)
        return total

    def facing(self) -> Floats:
        """Return how far each particle faces taught views, 0 to 1: less if it is turned beyond them, (p,)."""
        turned = np.abs(np.degrees(self.offsets()[:, 2])) / STEP_DEG
        steps = np.maximum(turned - TURNS_DEG.size / 2.0, 0.0)
        beyond = steps * math.radians(STEP_DEG) / self._map.apart_rad
        return np.asarray(np.exp(-2.0 * np.square(beyond)))

    def cosine(self, seen: ViewEvidence) -> float:
        """Return the mean cosine of a view with the views of these places."""
        cosines, _ = self.interpolated(seen.components)
        return float(self.weights @ cosines)

    def interpolated(self, components: Float32s) -> tuple[Floats, Floats]:
        """Return the cosines with the view at each particle's offset, and its distance beyond the views.

        A view between two stored views is their weighted sum, scaled to unit length. The distance is in steps aside
        and correlation lengths ahead.
        """
        offsets = self.offsets()
        by_turn, by_place = self._map.neighbour_cosines
        turned = (np.degrees(offsets[:, 2]) - TURNS_DEG[0]) / STEP_DEG
        inside = np.clip(turned, 0.0, TURNS_DEG.size - 1)
        turn_below = np.minimum(inside.astype(np.intp), TURNS_DEG.size - 2)
        turn_share = inside - turn_below
        aside = np.clip(offsets[:, 1] / self._map.aside, -1.0, 1.0) + 1.0
        place_below = np.minimum(aside.astype(np.intp), 1)
        place_share = aside - place_below

        def between(some: Any, rows: Indices) -> Floats:  # noqa: ANN401 - a slice or numbers
            place = place_below[some]
            beside = place_share[some]
            turn = turn_below[some]
            off = turn_share[some]
            places = np.stack([place, place + 1])
            turns = np.stack([turn, turn + 1])[:, None]
            less, more = self._map.cosines(components, rows, places, turns)
            turned = (1.0 - off) * less + off * more
            right, left = turned / _norm(off, by_turn[rows, places, turn])
            alike_less = by_place[rows, place, turn]
            alike_more = by_place[rows, place, turn + 1]
            alike = (1.0 - off) * alike_less + off * alike_more
            mixed = (1.0 - beside) * right + beside * left
            return np.asarray(mixed / _norm(beside, alike))

        found = self._map.best_variant(self.keyframes, between)
        length = self._map.correlation_length
        far_aside = np.maximum(np.abs(offsets[:, 1]) - self._map.aside, 0.0)
        far_ahead = np.maximum(np.abs(offsets[:, 0]) - 0.5 * length, 0.0)
        return found, np.hypot(far_aside / self._map.aside, far_ahead / length)

    @classmethod
    def joined(cls, *sets: tuple["Particles", float]) -> "Particles":
        """Join sets of particles, each with its share of the probability."""
        total = max(sum(share for _, share in sets), 1e-300)
        parts = [particles for particles, _ in sets]
        shares = [share / total for _, share in sets]
        keyframes = np.concatenate([part.keyframes for part in parts])
        poses = np.concatenate([part.poses for part in parts])
        joined = cls(parts[0]._map, keyframes, poses, parts[0]._config)
        joined.tracked = np.concatenate([part.tracked for part in parts])
        joined.pace = np.concatenate([part.pace for part in parts])
        weighted = zip(parts, shares, strict=True)
        joined.weights = np.concatenate([part.weights * share for part, share in weighted])
        weighted = zip(parts, shares, strict=True)
        joined.shares = np.sum([part.shares * share for part, share in weighted], axis=0)
        return joined

    def resampled(self, rng: np.random.Generator) -> Self:
        """Draw the usual number of particles by their weights; the new weights are equal."""
        which = systematic(self.weights, self._config.particles, rng)
        self.keyframes = self.keyframes[which]
        self.poses = self.poses[which]
        self.tracked = self.tracked[which]
        self.pace = self.pace[which]
        self.weights = np.full(which.size, 1.0 / which.size)
        return self


def _norm(share: Floats, cosine: AnyArray) -> Floats:
    """Return the length of a mixture of two unit vectors, of which the second has this share.

    Neighbouring views are never opposite; the limit prevents a division by zero for a damaged map.
    """
    rest = 1.0 - share
    squared = rest**2 + share**2 + 2.0 * share * rest * np.maximum(cosine, -0.5)
    return np.asarray(np.sqrt(squared))


def systematic(weights: AnyArray, count: int, rng: np.random.Generator) -> Indices:
    """Draw `count` indices by their weights (n,) with systematic resampling."""
    edges = np.cumsum(weights, dtype=np.float64)
    marks = (rng.random() + np.arange(count)) / max(count, 1) * edges[-1]
    drawn = np.searchsorted(edges, marks)
    return np.asarray(np.minimum(drawn, len(weights) - 1))

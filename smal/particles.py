"""Particles: poses beside taught keyframes, and how probable each of them is."""

import math
from dataclasses import dataclass
from typing import Any, Final, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from smal.camera import STEP_DEG, TURNS_DEG
from smal.likelihood import ANY_DAY, SHARES, over
from smal.map import VisualMap
from smal.movement import MotionNoise, Movement, seen_from, wrapped


@dataclass(frozen=True)
class FilterConfig:
    """Numbers of the filter; lengths are in correlation lengths of the map."""

    particles: int = 1000  # Of each set: more take longer and find no more.
    #: First belief: at the start of a taught drive, beside any way, lost.
    first: tuple[float, float, float] = (0.5, 0.35, 0.15)
    first_turn_deg: float = 30.0  # How far the heading may be off at the start of a drive.
    start_s: float = 0.5  # Starts scatter by what is driven in this time.
    #: Probability, with each new view, that the robot was carried or the filter follows a wrong place; larger where the
    #: view is unlike the one before.
    jump: float = 5e-3
    back: float = 0.05  # Probability, with each new view, that a lost robot is back beside the way.
    #: Probability, with each new view, that something that hid the place has gone.
    appears: float = 0.5
    #: Probability, with each new view, that as much shows as in another light, which lasts for about fifty new views.
    light: float = 0.02
    jitter_deg: float = 1.0  # Heading at every new view: cameras shake.
    #: How far a view counts that nobody taught. A robot that looks back sees 2 (campus) to 9 times (indoors) as much
    #: evidence for other places as it should. Counted by 0.7, one such view would be none; but views of one turn
    #: repeat each other.
    untaught: float = 0.3
    blind: float = 2.0  # Way without a view after which the wheels are believed half.
    located: float = 0.9  # Probability from which scouts look near a place after a jump.
    slip: float = 0.1  # Share of the way since then that the wheels may err.

    def hides(self, hidden: float) -> float:
        """Return the probability that something hides the next new view; in the long run a share is hidden."""
        return self.appears * hidden / (1.0 - hidden)

    def share_changes(self, hidden: float) -> NDArray[np.float64]:
        """Return how the share that shows changes with a new view, (from, to)."""
        hides = self.hides(hidden)
        rows = (1.0 - hides - self.light) * np.eye(SHARES.size) + self.light * ANY_DAY
        rows[:, 0] += hides
        rows[0] = self.appears * ANY_DAY
        rows[0, 0] = 1.0 - self.appears
        return rows


FILTER_CONFIG: Final = FilterConfig()


class ViewEvidence(NamedTuple):
    """What a robot's view looks like, and at which n keyframes it was looked for."""

    components: NDArray[np.float32]  # (r,) of the map (`VisualMap.described`).
    keyframes: NDArray[np.intp]
    stand_for: NDArray[np.float64]  # How many keyframes each of them stands for.
    cosines: NDArray[np.float32]  # (n, turns) with the views from there.
    middle: float  # Median, and spread, of its cosines with the sample of elsewhere.
    spread: float
    newness: float  # How much of it the views before have not told, 0 to 1.

    def stands_out(self, cosines: NDArray[Any]) -> NDArray[Any]:
        """Return by how much cosines stand out."""
        return over(cosines, self.middle, self.spread)


class Particles:
    """Poses in the axes of the drive of their keyframe, and weights that sum to 1."""

    def __init__(
        self,
        visual_map: VisualMap,
        keyframes: NDArray[np.intp],
        poses: NDArray[np.float64],
        config: FilterConfig = FILTER_CONFIG,
    ) -> None:
        self._map = visual_map
        self._config = config
        self.keyframes = keyframes
        self.poses = poses
        self.tracked = np.zeros(len(poses))
        self.weights = np.full(len(poses), 1.0 / len(poses))
        self.pace = np.zeros(
            len(poses)
        )  # By how many standard deviations the robot is faster than it is said to be.
        #: Probability of each share (`smal.likelihood.SHARES`) of what was taught that the next view shows.
        hidden = visual_map.config.hidden
        self.shares = (1.0 - hidden) * ANY_DAY + hidden * (SHARES == 0.0)
        #: How much likelier the last view was here than elsewhere, if all of it was new and nothing hid it.
        self.speaks = 1.0

    def move(
        self, movement: Movement, noise: MotionNoise, newness: float, rng: np.random.Generator
    ) -> float:
        """Predict: move all by a movement with noise, and find their keyframes; return the part that has strayed.

        Those that are nowhere near what was taught any more are let go, but for a trace.
        """
        ahead_noise, turn_noise, heading_noise, pace_noise = rng.standard_normal(
            (4, len(self.poses))
        )
        length = self._map.correlation_length
        lengths = abs(movement.ahead) / length
        # Errors of each moment are a diffusion: they grow with the square root of the way, whatever the rate of frames
        # and the speed. A wheel that is too large, or a driver in haste, stays so for a while.
        kept = math.exp(-lengths / noise.pace_lengths)
        self.pace = kept * self.pace + math.sqrt(1.0 - kept**2) * pace_noise
        ahead = movement.ahead * np.exp(noise.pace * self.pace)
        ahead += noise.ahead * math.sqrt(lengths) * length * ahead_noise
        heading = math.hypot(
            noise.drift_deg * math.sqrt(lengths), self._config.jitter_deg * math.sqrt(newness)
        )
        turn = movement.turn_rad + math.radians(heading) * heading_noise
        turn += noise.turn * math.sqrt(abs(movement.turn_rad)) * turn_noise
        middle = self.poses[:, 2] + turn / 2.0
        self.poses += np.stack([ahead * np.cos(middle), ahead * np.sin(middle), turn], axis=1)
        self.tracked += abs(movement.ahead)
        first, last = (edge[self.keyframes][:, None] for edge in self._map.key_range)
        near = np.clip(
            self.keyframes[:, None]
            + np.arange(-self._map.config.neighbours, self._map.config.neighbours + 1),
            first,
            last,
        )
        apart = self.poses[:, None] - self._map.key_poses[near]
        far = (apart[..., 0] ** 2 + apart[..., 1] ** 2) / length**2
        # A turn is covered by the virtual views: it counts for less than the place.
        far += (wrapped(apart[..., 2]) / (3.0 * self._map.apart_rad)) ** 2
        self.keyframes = np.take_along_axis(near, far.argmin(axis=1)[:, None], axis=1)[:, 0]
        away = (
            np.hypot(*(self.poses - self._map.key_poses[self.keyframes])[:, :2].T)
            > self._map.config.elsewhere * length
        )
        strayed = min(float(self.weights[away].sum()), 1.0 - 1e-6)
        self.weights[away] *= 1e-6
        self.weights /= self.weights.sum()
        return strayed

    def offsets(self) -> NDArray[np.float64]:
        """Return poses as seen from their keyframes: ahead, left, turned (p, 3)."""
        return seen_from(self.poses, self._map.key_poses[self.keyframes])

    def update(self, seen: ViewEvidence, rng: np.random.Generator) -> float:
        """Weigh by a view; return how much likelier it is here than elsewhere."""
        found, beyond = self.interpolated(seen.components)
        z = seen.stands_out(found)
        log_ratio = np.stack([self._map.likelihood.of(z, share) for share in range(SHARES.size)])
        # Far aside is like nowhere; where it looks away from all that was taught, the view says nothing.
        log_ratio[1:] = np.maximum(
            log_ratio[1:] - 2.0 * np.square(beyond), self._map.likelihood.log_ratio[1:, :1]
        )
        log_ratio *= self.looks()
        shown = self.shares[1:] / self.shares[1:].sum()
        self.speaks = float(shown @ np.exp(log_ratio[1:]) @ self.weights)
        likelihood = self.shares[:, None] * np.exp(seen.newness * log_ratio)
        joint = likelihood * self.weights
        total = float(joint.sum())
        self.weights = joint.sum(axis=0) / total
        shares = joint.sum(axis=1) / total
        changes = self._config.share_changes(self._map.config.hidden)
        self.shares = shares + (shares @ changes - shares) * seen.newness
        if (self.weights**2).sum() > 2.0 / len(self.weights):
            self.resampled(rng)
        return total

    def looks(self) -> NDArray[np.float64]:
        """Return how far each looks at what was taught, 0 to 1: less, where it is turned beyond all views (p,)."""
        turned = np.abs(np.degrees(self.offsets()[:, 2])) / STEP_DEG
        beyond = (
            np.maximum(turned - TURNS_DEG.size / 2.0, 0.0)
            * math.radians(STEP_DEG)
            / self._map.apart_rad
        )
        return np.asarray(np.exp(-2.0 * np.square(beyond)))

    def cosine(self, seen: ViewEvidence) -> float:
        """Return the mean cosine of a view with those of these places."""
        return float(self.weights @ self.interpolated(seen.components)[0])

    def interpolated(
        self, components: NDArray[np.float32]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the cosines with the view at each particle's offset, and how far that lies beyond views.

        Between two views the one between them is their sum, scaled to unit length; what lies beyond the outermost ones
        is in steps aside and correlation lengths ahead.
        """
        offsets = self.offsets()
        by_turn, by_place = self._map.neighbour_cosines
        turned = (np.degrees(offsets[:, 2]) - TURNS_DEG[0]) / STEP_DEG
        inside = np.clip(turned, 0.0, TURNS_DEG.size - 1)
        t = np.minimum(inside.astype(np.intp), TURNS_DEG.size - 2)
        f = inside - t
        aside = np.clip(offsets[:, 1] / self._map.aside, -1.0, 1.0) + 1.0
        p = np.minimum(aside.astype(np.intp), 1)
        g = aside - p

        def between(some: Any, rows: NDArray[np.intp]) -> NDArray[np.float64]:  # noqa: ANN401 - a slice or numbers
            first = p[some]
            left = g[some]
            turn = t[some]
            off = f[some]
            places = np.stack([first, first + 1])
            less, more = self._map.cosines(
                components, rows, places, np.stack([turn, turn + 1])[:, None]
            )
            here, beside = ((1.0 - off) * less + off * more) / _norm(
                off, by_turn[rows, places, turn]
            )
            places_alike = (1.0 - off) * by_place[rows, first, turn] + off * by_place[
                rows, first, turn + 1
            ]
            return np.asarray(((1.0 - left) * here + left * beside) / _norm(left, places_alike))

        found = self._map.best_look(self.keyframes, between)
        length = self._map.correlation_length
        beyond = np.hypot(
            np.maximum(np.abs(offsets[:, 1]) - self._map.aside, 0.0) / self._map.aside,
            np.maximum(np.abs(offsets[:, 0]) - 0.5 * length, 0.0) / length,
        )
        return found, beyond

    @classmethod
    def joined(cls, *sets: tuple["Particles", float]) -> "Particles":
        """Put sets together, each of which has a share."""
        total = max(sum(share for _, share in sets), 1e-300)
        names = ("keyframes", "poses", "tracked", "pace")
        keyframes, poses, tracked, pace = (
            np.concatenate([getattr(one, name) for one, _ in sets]) for name in names
        )
        made = cls(sets[0][0]._map, keyframes, poses, sets[0][0]._config)
        made.tracked = tracked
        made.pace = pace
        made.weights = np.concatenate([one.weights * (share / total) for one, share in sets])
        made.shares = np.sum([one.shares * (share / total) for one, share in sets], axis=0)
        return made

    def resampled(self, rng: np.random.Generator) -> Self:
        """Keep as many as usual, drawn by their weights, alike in weight."""
        which = systematic(self.weights, self._config.particles, rng)
        self.keyframes = self.keyframes[which]
        self.poses = self.poses[which]
        self.tracked = self.tracked[which]
        self.pace = self.pace[which]
        self.weights = np.full(which.size, 1.0 / which.size)
        return self


def _norm(share: NDArray[np.float64], cosine: NDArray[Any]) -> NDArray[np.float64]:
    """Return the length of a mixture of two unit vectors, of which the second has this share.

    Views beside each other are never opposite; a damaged map must not divide by zero.
    """
    squared = (1.0 - share) ** 2 + share**2 + 2.0 * share * (1.0 - share) * np.maximum(cosine, -0.5)
    return np.asarray(np.sqrt(squared))


def systematic(weights: NDArray[Any], count: int, rng: np.random.Generator) -> NDArray[np.intp]:
    """Draw so many indices by their weights (n,), as evenly as can be (systematic resampling)."""
    edges = np.cumsum(weights, dtype=np.float64)
    marks = (rng.random() + np.arange(count)) / max(count, 1) * edges[-1]
    return np.asarray(np.minimum(np.searchsorted(edges, marks), len(weights) - 1))

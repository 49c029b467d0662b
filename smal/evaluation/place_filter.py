"""Baseline of a Bayes filter over places: it recognises the taught frame, and repeats the velocity there.

Localization is as in PlaceNav: L. Suomela, J. Kalliola, H. Edelman, J.-K. Kämäräinen, "PlaceNav: Topological
Navigation through Place Recognition", ICRA 2024 (github lasuomela/PlaceNav), with the discrete Bayes filter of M. Xu,
N. Sünderhauf, M. Milford, "Probabilistic Visual Place Recognition for Hierarchical Localization", RA-L 2021: a uniform
motion model over a window of frame offsets, and the likelihood exp(-lambda d) of the distance d between global
descriptors. Steering is as in BearNav2 (G. Broughton et al., "Robust Image Alignment for Outdoor Teach-and-Repeat
Navigation", ECMR 2021; github broughtong/bearnav2): the taught velocity, and a turn proportional to the horizontal
shift of the image. Numbers without another reason are the authors'. Departures:

- The descriptor is SMAL's own, centred, so that all methods have the same knowledge (theirs: CosPlace). PlaceNav steers
  to the next place by a learned policy, and BearNav2 finds the shift with a learned network. Both were trained on the
  data of other robots. Here the shift is that of Dall'Osto et al. (`smal.evaluation.image_shift`).
- Places are all taught frames in which the robot moved, because the taught velocity must be that of the very frame.
  Frames and images come ten times a second, so that a robot at taught speed advances by one place with each image. The
  window is centred there (theirs: on the same place, because their places are four images apart).
- The taught velocity is measured by odometry over half a second, because keys command full speed or none.
- A robot that sees nothing taught looks around: a full turn to the left, and on to where the best place matched. Theirs
  begin beside the way and face along it. It does not announce the end of the way by an image that matches by chance.
"""

import itertools
import math
from collections.abc import Sequence
from typing import Final

import numpy as np

from smal.arrays import Float32s, Floats, Indices, Uint8s
from smal.camera import Image
from smal.evaluation.driver import Depth, PlaceEstimate
from smal.evaluation.image_shift import padded, prepared, turn_to
from smal.features import Centering, FeatureSettings, extract
from smal.movement import Atom, Motion, Movement
from smal.planning import Said
from smal.teaching.demonstration import Demonstration
from smal.teaching.movements import atom_movements

#: Offsets of the window, in frames: as wide as theirs (-1, 0, 1), about the taught speed.
OFFSETS: Final = (0, 1, 2)
#: Ratio of the likelihoods at the 2.5 and the 97.5 % quantile of the distances to the first image.
DELTA: Final = 10.0
_QUANTILES: Final = (0.025, 0.975)
#: Frames over which the taught velocity is measured, 0.5 s.
_AHEAD: Final = 5
#: Least movement of a place, as a share of full speed or of the full turn rate: slower frames are pauses.
_MOVES: Final = 0.1
#: Time constant of the correction of the heading by the shift: below the time in which a view changes.
_CORRECTS_S: Final = 0.5
#: Correlation of a first image that matches (`smal.evaluation.teach_and_repeat.SURE`).
_MATCHES: Final = 0.3
#: Quantile of the correlations of taught images that are this many places apart: up to it an image matches by chance.
_BY_CHANCE: Final = 0.95
_APART: Final = 20
#: Time without a match after which the robot looks around: longer than an obstacle hides the way in passing.
_LOST_S: Final = 2.0


class FrameFilter:
    """Discrete Bayes filter over places along one or several drives.

    Parameters
    ----------
    places : array (n, m)
        Descriptors of length 1.
    lengths : sequence of int
        Number of places of each drive; the robot does not pass from one drive to another.
    """

    def __init__(self, places: Float32s, lengths: Sequence[int]) -> None:
        self._places = places
        ends = np.cumsum(lengths)
        first = np.repeat(ends - lengths, lengths)
        last = np.repeat(ends - 1, lengths)
        every = np.arange(len(places))
        #: (offsets, n): where each place leads; the last place of a drive leads nowhere.
        self._targets = np.stack([np.clip(every + one, first, last) for one in OFFSETS])
        self.reset()

    def reset(self) -> None:
        """Forget all images; the next one calibrates the likelihood."""
        self._rate: float | None = None
        #: (n,) probability of each place.
        self.belief: Floats = np.full(len(self._places), 1.0 / len(self._places))

    def observe(self, descriptor: Float32s) -> Floats:
        """Update the belief by the descriptor (m,) of an image, and return it."""
        distances = np.sqrt(np.maximum(2.0 - 2.0 * (self._places @ descriptor), 0.0), dtype=float)
        if self._rate is None:
            near, far = np.quantile(distances, _QUANTILES)
            self._rate = math.log(DELTA) / float(far - near) if far > near else 0.0
            predicted = self.belief
        else:
            weights = np.tile(self.belief / len(OFFSETS), len(OFFSETS))
            moved = np.bincount(self._targets.ravel(), weights, len(self.belief))
            predicted = np.asarray(moved, dtype=float)
        # Scaling by the best place keeps the product within the range of numbers.
        belief = predicted * np.exp(-self._rate * (distances - distances.min()))
        self.belief = belief / belief.sum()
        return self.belief


class PlaceFilter:
    """Follows the most probable place of a `FrameFilter`.

    Parameters
    ----------
    drives : sequence of Demonstration
        Drives with images and odometry.
    features : FeatureSettings
        Features of the drives.
    field_rad : float
        Horizontal field of view of the camera, above 0 and below pi.

    Raises
    ------
    ValueError
        If a drive lacks images or odometry, or the drives have no turn or no way ahead.
    """

    def __init__(
        self, drives: Sequence[Demonstration], features: FeatureSettings, field_rad: float
    ) -> None:
        images, ways = zip(*map(_recorded, drives), strict=True)
        movements = atom_movements(ways, [drive.atoms for drive in drives])
        self._full = abs(movements[Atom.FORWARD, 0]), abs(movements[Atom.LEFT, 1])
        if not min(self._full) > 0.0:
            raise ValueError("the drives must show at least one turn and one way ahead")
        self._field_rad = field_rad
        self._features = features
        self._centering = Centering.fit([drive.rows for drive in drives], features)
        velocities = [_velocities(way, self._full) for way in ways]
        moving = [_moving(one) for one in velocities]
        firsts = np.cumsum([0, *map(len, ways[:-1])])
        #: (n,) frame of each place, counted over all drives, and (n, 2) taught velocity there.
        self._frames = np.concatenate(
            [first + one for first, one in zip(firsts, moving, strict=True)]
        )
        self._velocities = np.concatenate(velocities)[self._frames]
        rows = np.concatenate([self._centering.apply(drive.rows) for drive in drives])
        lengths = [len(one) for one in moving]
        self._filter = FrameFilter(rows[self._frames], lengths)
        self._ends = {int(end) - 1 for end in np.cumsum(lengths)}
        pictures = [
            [prepared(kept[int(frame)]) for frame in frames]
            for kept, frames in zip(images, moving, strict=True)
        ]
        self._pictures = [padded(one) for drive in pictures for one in drive]
        self._chance = _by_chance(pictures, field_rad)
        self.reset()

    def reset(self, seed: int = 0) -> None:
        """Start a new episode; the method has no random numbers."""
        del seed
        self._filter.reset()
        self.said: Said | None = None
        self.place: PlaceEstimate | None = None
        self._unmatched_s = _LOST_S  # A first image that does not match is enough.
        self._look: _Look | None = None

    def step(
        self, image: Uint8s, odometry: Sequence[float], depth: Depth | None, elapsed_s: float
    ) -> Motion:
        """Return the velocity until the next image; see `Driver.step`."""
        del depth
        belief = self._filter.observe(self._centering.apply(extract(image, self._features)))
        best = int(belief.argmax())
        off_rad, correlation = turn_to(self._pictures[best], prepared(image), self._field_rad)
        if self._is_lost(correlation, off_rad, odometry[2], elapsed_s):
            self._filter.reset()
            self.place = None
            return 0.0, 1.0
        self.place = PlaceEstimate(int(self._frames[best]), turned_rad=-off_rad)
        ahead, turn = self._velocities[best].tolist()
        if correlation > self._chance:
            turn += off_rad / self._full[1] * elapsed_s / _CORRECTS_S
            self.said = "found" if best in self._ends else None
        return ahead, float(np.clip(turn, -1.0, 1.0))

    def _is_lost(
        self, correlation: float, off_rad: float, heading: float, elapsed_s: float
    ) -> bool:
        """Return whether the robot looks around, by how well its image matches the best place."""
        if self._look is None:
            least = _MATCHES if self.place is None else self._chance
            self._unmatched_s = 0.0 if correlation > least else self._unmatched_s + elapsed_s
            if self._unmatched_s < _LOST_S:
                return False
            self._look = _Look(heading)
        if not self._look.ends(correlation, heading + off_rad, heading):
            return True
        self._look = None
        self._unmatched_s = 0.0
        return False


class _Look:
    """A look around: a full turn, and on to the heading at which an image matched best."""

    def __init__(self, heading: float) -> None:
        self._last = heading
        self._turned_rad = 0.0
        #: Best correlation, and the heading there.
        self._best = (-math.inf, heading)

    def ends(self, correlation: float, taught: float, heading: float) -> bool:
        """Return whether the robot faces the best heading after a full turn."""
        step_rad = math.remainder(heading - self._last, math.tau)
        self._turned_rad += step_rad
        self._last = heading
        if self._turned_rad < math.tau:
            self._best = max(self._best, (correlation, taught))
            return False
        to_best = math.remainder(self._best[1] - heading, math.tau)
        # A robot that has turned past it, by less than a step, faces it as well.
        return abs(to_best) <= max(step_rad, 0.0) or self._turned_rad >= 2.0 * math.tau


def _recorded(drive: Demonstration) -> tuple[Sequence[Image], Floats]:
    """Return the images and the odometry of a drive."""
    if drive.images is None or drive.odometry is None:
        raise ValueError(f"demonstration {drive.name}: a place filter needs images and odometry")
    return drive.images, drive.odometry


def _by_chance(drives: Sequence[Sequence[Float32s]], field_rad: float) -> float:
    """Return the correlation that pictures of other places of the same drive reach by chance."""
    apart = [pictures[:: max(min(_APART, len(pictures) // 2), 1)] for pictures in drives]
    pairs = [pair for pictures in apart for pair in itertools.permutations(pictures, 2)]
    correlations = [turn_to(padded(one), other, field_rad)[1] for one, other in pairs]
    return float(np.quantile(correlations, _BY_CHANCE))


def _velocities(way: Floats, full: tuple[float, float]) -> Floats:
    """Return the taught velocity (f, 2) at each pose (f, 3), as shares of full speed and turn rate."""
    last = len(way) - 1
    found = np.zeros((len(way), 2))
    for frame in range(last):
        ahead = min(frame + _AHEAD, last)
        moved = Movement.between(way[frame].tolist(), way[ahead].tolist())
        found[frame] = np.divide((moved.ahead, moved.turn_rad), full) / (ahead - frame)
    return np.clip(found, -1.0, 1.0)


def _moving(velocities: Floats) -> Indices:
    """Return the frames in which the robot moves, and the last."""
    moves = np.abs(velocities).max(axis=1) >= _MOVES
    moves[-1] = True
    return np.flatnonzero(moves)

"""Baseline of the nearest frames: recognition by the most similar window of all drives, and its imitation."""

from collections.abc import Sequence

import numpy as np

from smal.arrays import Float32s, Uint8s
from smal.evaluation.driver import Depth, PlaceEstimate
from smal.features import Centering, FeatureSettings, extract
from smal.movement import MOTIONS, STANDS, Atom, Motion
from smal.place_recognition import Matches
from smal.place_recognition.matches import NONE
from smal.place_recognition.nearest_sequence import match_nearest_sequence
from smal.planning import Said
from smal.teaching.demonstration import Demonstration


def recognize_nearest(drives: Sequence[Float32s], views: Float32s, length: int) -> Matches:
    """Match each window of centred features with the most similar window of all drives.

    Windows do not cross the border of two drives.
    """
    found = [match_nearest_sequence(each, views, length) for each in drives]
    starts = np.cumsum([0, *map(len, drives[:-1])])
    scores = np.stack([np.where(one.matched, one.score, -np.inf) for one in found])
    references = np.stack([start + one.reference for start, one in zip(starts, found, strict=True)])
    best = scores.argmax(axis=0)
    every = np.arange(len(views))
    matched = np.isfinite(scores.max(axis=0))
    answered = np.where(matched, references[best, every], NONE)
    score = np.where(matched, scores[best, every], 0.0)
    return Matches(answered, score, np.zeros(len(views)))


class NearestImitation:
    """Repeats the action at the taught frame with the most similar window; announces "found" at the end of a drive.

    Parameters
    ----------
    drives : sequence of Demonstration
    features : FeatureSettings
        Features of the drives.
    frames : int
        Length of a window.
    """

    def __init__(
        self, drives: Sequence[Demonstration], features: FeatureSettings, frames: int = 1
    ) -> None:
        self._features = features
        self._frames = frames
        raw = [one.rows for one in drives]
        self._centering = Centering.fit(raw, features)
        self._drives = [self._centering.apply(each) for each in raw]
        self._atoms = np.concatenate([one.atoms for one in drives])
        self._ends = {int(end) - 1 for end in np.cumsum([len(one.atoms) for one in drives])}
        self.reset()

    def reset(self, seed: int = 0) -> None:
        """Start a new episode; the method has no random numbers."""
        del seed
        self._seen: list[Float32s] = []
        self.said: Said | None = None
        self.place: PlaceEstimate | None = None

    def step(
        self,
        image: Uint8s,
        odometry: Sequence[float] | None = None,
        depth: Depth | None = None,
        elapsed_s: float | None = None,
    ) -> Motion:
        """Return the velocity until the next image; see `Driver.step`. Only the image is used."""
        del odometry, depth, elapsed_s
        view = self._centering.apply(extract(image, self._features))
        self._seen = [*self._seen, view][-self._frames :]
        matches = recognize_nearest(self._drives, np.stack(self._seen), len(self._seen))
        frame = int(matches.reference[-1])
        self.place = PlaceEstimate(frame)
        if frame in self._ends:
            self.said = "found"
            return STANDS
        return MOTIONS[Atom(int(self._atoms[frame]))]

"""SeqSLAM (Milford & Wyeth, ICRA 2012) as the eyes of a robot that searches: frame after frame, ending now.

The demonstrations are the templates. A frame's difference from each of them is enhanced locally within its
demonstration, trajectories lie within one demonstration and end at the last frame. The end of the best one is where
the robot is.
"""

from collections import deque
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from smal.demonstration import Demonstration
from smal.features import FeatureSettings, extract
from smal.movement import Atom
from smal.place_recognition.seqslam import SeqSlamSettings, differences, enhanced

#: The paper's trajectories of 10 frames. Its neighbourhood of 10 frames is too small for ten frames a second, in which
#: neighbours hardly differ, and what is enhanced is noise: on drives of the indoor world the place was off by more than
#: 2.5 m in one of ten frames, with 40 frames by 0.13 m. On the campus it collides whatever the settings: neighbourhoods
#: of 10 to 160 frames, trajectories of 5 to 40, velocities of 0.5 to 2 (three searches each).
SEQSLAM: Final = SeqSlamSettings(length=10, window=40)
SEQSLAM_FEATURES: Final = FeatureSettings.of(("thumbnail",))


class Place(NamedTuple):
    """A frame of a demonstration: number of the demonstration, frame, and the mean enhanced difference there."""

    demonstration: int
    frame: int
    cost: float


class SeqSlamLocalizer:
    """Finds the demonstrated frame at which the last d_s frames end.

    There is no novelty test: SeqSLAM's uniqueness asks whether a second place matches as well, and with many
    demonstrations of one route the second best is the same place in another of them. So it always answers.

    Parameters
    ----------
    drives : sequence of float32 arrays (f, m)
        Patch-normalized thumbnails (the modality `thumbnail`) of every demonstration, one at least long enough for a
        trajectory.
    settings : SeqSlamSettings
    shorten : bool
        Whether it answers from the first frame on, by as many frames as there are: a robot that waits for d_s frames
        stands still meanwhile, which is no trajectory that is tried.
    """

    def __init__(self, drives: Sequence[NDArray[np.float32]], settings: SeqSlamSettings, shorten: bool = False) -> None:
        self._settings, self._least = settings, 1 if shorten else settings.length
        self._lines = settings.trajectories()
        self._ends = np.cumsum([0, *map(len, drives)])
        self._templates = np.concatenate(drives)
        # Where in its demonstration each template is: a trajectory must not begin before it.
        self._frame = np.concatenate([np.arange(len(each)) for each in drives])
        if not any(line[-1] <= self._frame.max() for line in self._lines):
            raise ValueError(f"no demonstration is long enough for SeqSLAM with a length of {settings.length}")
        self._rows: deque[NDArray[np.float32]] = deque(maxlen=settings.length)

    def reset(self) -> None:
        """Forget all frames, for a new episode."""
        self._rows.clear()

    def observe(self, frame: NDArray[np.float32]) -> Place | None:
        """Take one frame, (m,), and find where the last d_s ended; None as long as there are too few."""
        self._rows.append(self._contrast(frame))
        if len(self._rows) < self._least:
            return None
        rows = list(reversed(self._rows))
        best = np.full(self._frame.size, np.inf, dtype=np.float32)
        for line in {tuple(line[: len(rows)]) for line in self._lines}:
            total = np.full(self._frame.size, np.inf, dtype=np.float32)
            reach = line[-1]
            total[reach:] = 0.0
            for row, step in zip(rows, line, strict=True):
                total[reach:] += row[reach - step : row.size - step]
            np.minimum(best, np.where(self._frame >= reach, total, np.inf), out=best)
        end = int(best.argmin())
        demonstration = int(np.searchsorted(self._ends, end, side="right")) - 1
        return Place(demonstration, int(self._frame[end]), float(best[end]) / len(rows))

    def _contrast(self, query: NDArray[np.float32]) -> NDArray[np.float32]:
        """Local contrast enhancement of one frame against all templates, within each demonstration."""
        row = differences(self._templates, query[np.newaxis])
        parts = [
            enhanced(np.ascontiguousarray(row[:, start:end]), self._settings.half_window)
            for start, end in zip(self._ends[:-1], self._ends[1:], strict=True)
        ]
        contrast: NDArray[np.float32] = np.concatenate(parts, axis=1)[0]
        return contrast


class SeqSlamImitation:
    """Does what was done at the demonstrated frame that SeqSLAM finds.

    Parameters
    ----------
    demonstrations : sequence of Demonstration
        With images.
    settings : SeqSlamSettings
    """

    def __init__(self, demonstrations: Sequence[Demonstration], settings: SeqSlamSettings = SEQSLAM) -> None:
        self._localizer = SeqSlamLocalizer(seqslam_templates(demonstrations), settings, shorten=True)
        self._atoms = [one.atoms for one in demonstrations]

    def reset(self) -> None:
        """Forget all frames, for a new episode."""
        self._localizer.reset()

    def step(self, image: NDArray[np.uint8], odometry: Sequence[float] | None = None) -> Atom:
        """Take one image, (height, width, 3) RGB, and return what to do; the wheels do not count."""
        del odometry
        place = self._localizer.observe(extract(image, SEQSLAM_FEATURES))
        return Atom.STOP if place is None else Atom(int(self._atoms[place.demonstration][place.frame]))


def seqslam_templates(demonstrations: Sequence[Demonstration]) -> list[NDArray[np.float32]]:
    """Return what SeqSLAM knows of each demonstration: the features (f, m) of its images."""
    return [np.stack([extract(image, SEQSLAM_FEATURES) for image in one.images or ()]) for one in demonstrations]

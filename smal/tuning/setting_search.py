"""Searching settings of a method of place recognition: coordinate search over weights, length and penalty."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Final

import numpy as np
from numpy.typing import NDArray

from smal.evaluation.ground_truth import Judgement
from smal.evaluation.precision_recall import PrecisionRecall
from smal.features import FeatureSettings
from smal.place_recognition.methods import MatchSettings

#: Relative weights that are tried for a modality; 0 leaves it out.
FACTORS: Final = (0.0, 0.5, 1.0, 2.0)
#: The search ends after so many rounds over all coordinates even if the last one found something.
_MOST_ROUNDS: Final = 3
#: A smaller gain is rounding.
_GAIN: Final = 1e-9

#: Settings -> what became of every query, one judgement for each trial (one pair of traverses each).
Evaluate = Callable[[MatchSettings], Sequence[Judgement]]
#: Called with the settings tried so far, and how many it will be if the search goes on as it does.
SearchProgress = Callable[[int, int], None]
#: For each trial which of its queries count, bool (q,).
Part = Sequence[NDArray[np.bool_]]


@dataclass(frozen=True)
class SearchSpace:
    """What is tried.

    Parameters
    ----------
    modalities : tuple of str
        Candidates; which of them count, and how much, is searched.
    lengths : tuple of int
        Frames of a window.
    penalties : tuple of float
        See `MatchSettings`; empty if the method has none.
    """

    modalities: tuple[str, ...]
    lengths: tuple[int, ...]
    penalties: tuple[float, ...]

    @property
    def steps(self) -> int:
        """Settings that a round tries, at most."""
        return len(self.modalities) * len(FACTORS) + len(self.lengths) + len(self.penalties)

    def alone(self, settings: MatchSettings) -> list[MatchSettings]:
        """Return the settings with each modality alone."""
        return [replace(settings, features=FeatureSettings.of((name,))) for name in self.modalities]

    def coordinates(self) -> Iterator[Callable[[MatchSettings], list[MatchSettings]]]:
        """Yield functions from settings to those that differ from them in one thing."""
        for name in self.modalities:
            yield partial(self._weighings, name)
        yield lambda settings: [replace(settings, penalty=penalty) for penalty in self.penalties]
        yield lambda settings: [replace(settings, length=length) for length in self.lengths]

    def _weighings(self, name: str, settings: MatchSettings) -> list[MatchSettings]:
        return [self._weighing(settings, name, factor) for factor in FACTORS]

    def _weighing(self, settings: MatchSettings, name: str, factor: float) -> MatchSettings:
        """Give one modality another weight; the largest of all weights is 1, so that equal ratios are equal."""
        features = settings.features
        weights = dict(zip(features.modalities, features.weights, strict=True)) | {name: factor}
        kept = [one for one in self.modalities if weights.get(one, 0.0) > 0.0]
        if not kept:
            return settings
        largest = max(weights.values())
        return replace(settings, features=FeatureSettings.of(kept, [weights[one] / largest for one in kept]))


class Trials:
    """Settings that have been tried, each only once however many searches ask for it.

    Parameters
    ----------
    evaluate : callable
        See `Evaluate`.
    progress : callable
        See `SearchProgress`.
    """

    def __init__(self, evaluate: Evaluate, progress: SearchProgress) -> None:
        self._evaluate, self._progress = evaluate, progress
        self._found: dict[MatchSettings, tuple[Judgement, ...]] = {}
        self._to_come = 0

    @property
    def tried(self) -> tuple[MatchSettings, ...]:
        """All settings so far, in their order."""
        return tuple(self._found)

    def expect(self, more: int) -> None:
        """Say how many settings are still to come, about."""
        self._to_come = more
        self._progress(len(self._found), len(self._found) + more)

    def judgements(self, settings: MatchSettings) -> tuple[Judgement, ...]:
        """Return what became of the queries of each trial."""
        if settings not in self._found:
            self._found[settings] = tuple(self._evaluate(settings))
        self.expect(max(0, self._to_come - 1))
        return self._found[settings]

    def auc(self, settings: MatchSettings, part: Part) -> float:
        """Return the area under the precision-recall curve, see `mean_auc`."""
        return mean_auc(self.judgements(settings), part)

    def best(self, candidates: Sequence[MatchSettings], part: Part) -> MatchSettings:
        """Return the candidate with the largest area; of those that are as good the first."""
        best, most = candidates[0], self.auc(candidates[0], part)
        for candidate in candidates[1:]:
            area = self.auc(candidate, part)
            if area > most + _GAIN:
                best, most = candidate, area
        return best


def mean_auc(judgements: Sequence[Judgement], part: Part) -> float:
    """Return the area under the precision-recall curve of a part, the mean over the trials with anything to find."""
    return float(np.mean([PrecisionRecall.of(one).auc for one in restricted(judgements, part)]))


def restricted(judgements: Sequence[Judgement], part: Part) -> list[Judgement]:
    """Return the judgements of the queries in a part, of the trials with anything to find in it.

    Raises
    ------
    ValueError
        There is no such trial.
    """
    found = [
        replace(one, judged=one.judged & inside, findable=one.findable & inside, right=one.right & inside)
        for one, inside in zip(judgements, part, strict=True)
        if (one.findable & inside).any()
    ]
    if not found:
        raise ValueError("none of the queries that settings are compared by has anything to find")
    return found


def search(
    trials: Trials, space: SearchSpace, starts: Sequence[MatchSettings], part: Part, after: int
) -> MatchSettings:
    """Improve settings one coordinate at a time until none improves them, judged by some of the queries.

    Parameters
    ----------
    trials : Trials
    space : SearchSpace
    starts : sequence of MatchSettings
        At least one; the search begins at the best of them, and keeps the first where nothing is better.
    part : sequence of bool arrays (q,)
        Which queries count.
    after : int
        How many settings searches after this one will try, for the progress.
    """
    best = trials.best(starts, part)
    for _ in range(_MOST_ROUNDS):
        before = best
        trials.expect(space.steps + after)
        for neighbours in space.coordinates():
            # Nothing is better than all.
            if trials.auc(best, part) >= 1.0 - _GAIN:
                return best
            best = trials.best([best, *neighbours(best)], part)
        if best == before:
            break
    return best

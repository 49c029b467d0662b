"""Testing what was chosen on queries that did not choose."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from smal.evaluation.ground_truth import Judgement
from smal.evaluation.precision_recall import block_length, bootstrap
from smal.place_recognition.methods import MatchSettings
from smal.tuning.score_threshold import Answers, choose_threshold, count_answers, pooled
from smal.tuning.setting_search import Part, Trials, restricted

#: Queries for each frame of the longest window: one has no such window yet, and of the others half is left to choose.
QUERIES_PER_FRAME: Final = 5
#: Blocks that the queries are cut into, at most.
_MOST_BLOCKS: Final = 10
_INTERVAL: Final = (2.5, 97.5)


@dataclass(frozen=True)
class Figure:
    """A figure and its 95 % bootstrap interval."""

    value: float
    interval: tuple[float, float]


@dataclass(frozen=True)
class HeldOut:
    """What defaults and tuned settings are worth on queries that did not choose.

    Parameters
    ----------
    default, tuned : Figure
        Area under the curve, the mean of the halves weighted by their queries that have anything to find.
    difference : Figure
        Tuned minus default, of paired draws.
    chosen : tuple of MatchSettings
        What each half chose.
    """

    default: Figure
    tuned: Figure
    difference: Figure
    chosen: tuple[MatchSettings, ...]


@dataclass(frozen=True)
class Fold:
    """Which queries choose, and which test what they chose."""

    choosing: Part
    testing: Part


def with_window(judgements: Sequence[Judgement], length: int) -> Part:
    """Return which judged queries of each trial end a window of `length` frames."""
    return [one.judged & (np.arange(one.judged.size) >= length - 1) for one in judgements]


def make_folds(judged: Sequence[NDArray[np.bool_]], length: int) -> tuple[Fold, Fold]:
    """Cut the queries into two halves of blocks that test each other.

    Parameters
    ----------
    judged : sequence of bool arrays (q,)
        Of each trial which queries count; the queries of all trials are the same places.
    length : int
        Frames of the longest window.

    Returns
    -------
    two Folds
        Queries that choose are at least `length` frames from those that test. Of several trials, those that choose
        are others than those that test.

    Raises
    ------
    ValueError
        Fewer than 4 such queries for each frame of a window.
    """
    numbers = np.flatnonzero(np.logical_and.reduce(judged))
    least = (QUERIES_PER_FRAME - 1) * length
    if numbers.size < least:
        raise ValueError(
            f"{numbers.size} judged windows of {length} frames are too few to test what they choose: it takes {least}"
        )
    pairs = min(_MOST_BLOCKS // 2, max(1, numbers.size // (2 * least)))
    halves = np.zeros((2, judged[0].size), dtype=np.bool_)
    for block, members in enumerate(np.array_split(numbers, 2 * pairs)):
        halves[block % 2, members] = True
    first, second = (_fold(halves[k], halves[1 - k], length, k, len(judged)) for k in range(2))
    return first, second


def _fold(own: NDArray[np.bool_], other: NDArray[np.bool_], length: int, parity: int, trials: int) -> Fold:
    others = np.flatnonzero(other)
    numbers = np.flatnonzero(own)
    after = np.searchsorted(others, numbers)
    apart = np.minimum(
        np.abs(numbers - others[np.minimum(after, others.size - 1)]), np.abs(numbers - others[np.maximum(after - 1, 0)])
    )
    choosing = np.zeros_like(own)
    choosing[numbers[apart >= length]] = True
    none = np.zeros_like(own)
    if trials == 1:
        return Fold([choosing], [other])
    chooses = [trial % 2 == parity for trial in range(trials)]
    return Fold([choosing if one else none for one in chooses], [none if one else other for one in chooses])


def check_folds(judgements: Sequence[Judgement], folds: Sequence[Fold]) -> None:
    """Refuse halves (ValueError) without anything to find."""
    for fold in folds:
        for part in (fold.choosing, fold.testing):
            if not any((one.findable & inside).any() for one, inside in zip(judgements, part, strict=True)):
                raise ValueError(
                    "one half of the queries has nothing to find, so that what is chosen could not be tested"
                )


def compare_held_out(
    trials: Trials, default: MatchSettings, chosen: Sequence[MatchSettings], folds: Sequence[Fold], seed: int
) -> HeldOut:
    """Compare on each fold's test the default with what the fold chose, and join the folds."""
    values, draws, counts = [], [], []
    for number, (settings, fold) in enumerate(zip(chosen, folds, strict=True)):
        both = [restricted(trials.judgements(one), fold.testing) for one in (default, settings)]
        values.append([trials.auc(one, fold.testing) for one in (default, settings)])
        block = block_length(int(both[0][0].judged.sum()), max(default.length, settings.length))
        # The same seed for both, so that their draws are of the same queries.
        draws.append([_mean_draws(tests, block, seed + number) for tests in both])
        counts.append(sum(int(one.findable.sum()) for one in both[0]))
    value = np.average(values, axis=0, weights=counts)
    drawn = np.average(draws, axis=0, weights=counts)
    return HeldOut(
        _figure(value[0], drawn[0]),
        _figure(value[1], drawn[1]),
        _figure(value[1] - value[0], drawn[1] - drawn[0]),
        tuple(chosen),
    )


def _mean_draws(tests: Sequence[Judgement], block: int, seed: int) -> NDArray[np.float64]:
    mean: NDArray[np.float64] = np.mean([bootstrap(one, block, seed=seed)[:, 0] for one in tests], axis=0)
    return mean


def _figure(value: float, drawn: NDArray[np.float64]) -> Figure:
    low, high = np.nanpercentile(drawn, _INTERVAL).tolist()
    return Figure(float(value), (low, high))


def count_held_out_answers(
    trials: Trials, chosen: Sequence[MatchSettings], folds: Sequence[Fold], precision: float
) -> Answers | None:
    """Count the answers of each half with the threshold of the other; None where a half finds no threshold."""
    counted = []
    for settings, fold in zip(chosen, folds, strict=True):
        judgements = trials.judgements(settings)
        threshold = choose_threshold(pooled(restricted(judgements, fold.choosing)), precision)
        if threshold is None:
            return None
        counted.append(count_answers(pooled(restricted(judgements, fold.testing)), threshold.tau))
    return Answers(
        sum(one.given for one in counted), sum(one.right for one in counted), sum(one.findable for one in counted)
    )

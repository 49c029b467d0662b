"""What ``smal tune`` searches: trials on a labelled pair of folders, or on one folder alone."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from services.experiments.matching.image_folder import (
    Change,
    DescribedFrames,
    ImageFolder,
    describe_frames,
    read_truth_of,
    say_skipped,
)
from services.experiments.tuning.report import Unlabelled
from services.kit.errors import JobError
from smal.evaluation.ground_truth import IntervalTruth
from smal.features import FeatureSettings
from smal.place_recognition.methods import MatchSettings
from smal.tuning.cross_validation import QUERIES_PER_FRAME, with_window
from smal.tuning.other_conditions import Conditions, evening, overcast
from smal.tuning.recommendation import Tuning
from smal.tuning.score_threshold import choose_threshold, pooled
from smal.tuning.setting_search import mean_auc, restricted
from smal.tuning.setting_trials import SettingTrials, TraversePair

_LENGTHS: Final = (5, 10, 15, 20)
#: Degradations are made stronger until the defaults fail for some queries: nothing can be learned from what all know.
_STRENGTHS: Final = (1.0, 1.5, 2.0, 3.0)
_PERFECT: Final = 0.95
#: Without labels: right are references at most so many frames from a query.
_RIGHT_FRAMES: Final = 3
#: And a place is one that no reference shows if the next is farther than this; between the two nothing is judged.
_UNKNOWN_FRAMES: Final = 10
_LEAST_IMAGES: Final = 60
_IMAGES_PER_FRAME: Final = 5


@dataclass(frozen=True, eq=False)
class Problem:
    """What is searched.

    Attributes
    ----------
    trials
        Evaluates settings.
    start
        The defaults; the length is in frames of the trials.
    lengths
        What is searched.
    unlabelled
        What was done where there are no labels.
    gapped
        Then: the same without the middle of the references, for tau.
    """

    trials: SettingTrials
    start: MatchSettings
    lengths: tuple[int, ...]
    unlabelled: Unlabelled | None = None
    gapped: tuple[TraversePair, ...] = ()


def labelled(
    name: str,
    references: ImageFolder,
    queries: ImageFolder,
    held: FeatureSettings,
    start: MatchSettings,
    path: Path,
    any_length: bool,
) -> Problem:
    """Read two folders and what is right.

    Raises
    ------
    UsageError
        When the truth cannot be used.
    JobError
        When there are too few frames, or none can be read.
    """
    truth = read_truth_of(path, queries, references)
    known = describe_frames(references, held, None, "reading references")
    seen = describe_frames(queries, held, None, "reading queries")
    say_skipped(references, known)
    say_skipped(queries, seen)
    judged = int(truth.judged[seen.numbers].sum())
    most = min(judged // QUERIES_PER_FRAME, known.numbers.size // 2)
    if most < start.length:
        raise JobError(
            f"{queries.path}: {judged} judged queries and {known.numbers.size} references are too few for windows of "
            f"{start.length} frames; with --length L it takes {QUERIES_PER_FRAME} L queries and 2 L references"
        )
    lengths = tuple(one for one in _LENGTHS if one <= most) if any_length else (start.length,)
    pair = TraversePair(known.features, seen.features, held, _of_read(truth, seen.numbers, known.numbers))
    return Problem(SettingTrials(name, (pair,)), start, lengths)


def _of_read(truth: IntervalTruth, queries: NDArray[np.int64], references: NDArray[np.int64]) -> IntervalTruth:
    """Return the truth of the frames that could be read; a place of which none could cannot be found."""
    first = np.searchsorted(references, truth.first[queries])
    last = np.searchsorted(references, truth.last[queries], side="right") - 1
    gone = ~truth.findable[queries] | (last < first)
    return IntervalTruth(np.where(gone, -1, first), np.where(gone, -1, last), truth.judged[queries])


def unlabelled(name: str, references: ImageFolder, held: FeatureSettings, start: MatchSettings, seed: int) -> Problem:
    """Make queries of every second frame, at the least strength that some of them do not survive."""
    count = len(references.frames)
    least = max(_LEAST_IMAGES, _IMAGES_PER_FRAME * start.length)
    if count < least:
        raise JobError(
            f"{references.path}: {count} images are too few to tune without labels for windows of {start.length}: "
            f"it takes {least}"
        )
    known = describe_frames(references, held, None, "reading references", frames=range(0, count, 2))
    *weaker, strongest = _STRENGTHS
    for strength in weaker:
        problem = _degraded(name, references, known, held, start, strength, seed)
        judgements = problem.trials(problem.start)
        if mean_auc(judgements, with_window(judgements, problem.start.length)) < _PERFECT:
            return problem
    return _degraded(name, references, known, held, start, strongest, seed)


def _degraded(
    name: str,
    references: ImageFolder,
    known: DescribedFrames,
    held: FeatureSettings,
    start: MatchSettings,
    strength: float,
    seed: int,
) -> Problem:
    """Show the frames between the known ones under two other conditions."""
    conditions = (evening(strength), overcast(strength))
    titles = [f"degraded views, strength {strength:g}, {place} of {len(conditions)}" for place in (1, 2)]
    between = range(1, len(references.frames), 2)
    views = [
        describe_frames(
            references, held, None, titles[place], frames=between, change=_degrading(condition, seed + place)
        )
        for place, condition in enumerate(conditions)
    ]
    if strength == _STRENGTHS[0]:  # what is skipped is the same each time
        say_skipped(references, replace(known, unreadable=known.unreadable + views[0].unreadable))
    said = tuple(f"strength {strength:g}: {condition.meaning}" for condition in conditions)
    gapped = _with_gap(known)
    return Problem(
        SettingTrials(name, tuple(_pair(known, seen, held) for seen in views)),
        replace(start, length=1),
        (1,),
        Unlabelled(start.length, said),
        tuple(_pair(gapped, seen, held) for seen in views),
    )


def _degrading(conditions: Conditions, seed: int) -> Change:
    return lambda image, number: conditions.degrade(image, seed, number)


def _with_gap(known: DescribedFrames) -> DescribedFrames:
    """Leave out the middle third, so that there are queries at places that no reference shows."""
    rows = np.arange(known.numbers.size)
    kept = (rows < rows.size // 3) | (rows >= 2 * rows.size // 3)
    return DescribedFrames(known.features[kept], known.numbers[kept], ())


def _pair(known: DescribedFrames, seen: DescribedFrames, held: FeatureSettings) -> TraversePair:
    """Pair frames of one traverse: right are references near a query, and what is not quite as near is not judged."""
    first, last = _within(seen.numbers, known.numbers, _RIGHT_FRAMES)
    farther_first, farther_last = _within(seen.numbers, known.numbers, _UNKNOWN_FRAMES)
    is_right, is_unknown = first <= last, farther_first > farther_last
    truth = IntervalTruth(np.where(is_right, first, -1), np.where(is_right, last, -1), is_right | is_unknown)
    return TraversePair(known.features, seen.features, held, truth)


def _within(
    queries: NDArray[np.int64], references: NDArray[np.int64], frames: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the first and the last row of the references at most so many frames away; last < first if none is."""
    return np.searchsorted(references, queries - frames), np.searchsorted(references, queries + frames, "right") - 1


def with_threshold(problem: Problem, name: str, tuning: Tuning, precision: float) -> Tuning:
    """Choose tau without labels, over known and unknown places.

    The frames are twice as far apart, so that windows of half as many cover the way of those that are recommended.
    """
    if problem.unlabelled is None:
        return tuning
    settings = replace(tuning.recommended, length=(problem.unlabelled.length + 1) // 2)
    judgements = SettingTrials(name, problem.gapped)(settings)
    judged = restricted(judgements, with_window(judgements, settings.length))
    return replace(tuning, threshold=choose_threshold(pooled(judged), precision), held_out_answers=None)

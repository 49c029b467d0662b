"""Choosing the settings of a method from traverses whose truth is known, without believing them too much.

Settings are searched by area under the precision-recall curve. The best of many settings is better on the queries that
chose it than on any others, so that the search is cross-validated: it is done on one half of the queries and its
winner is held against the defaults on the other half, then the other way round. Successive queries see nearly the
same, so a half is made of blocks of successive queries, and queries whose windows share frames with the other half do
not choose. Queries before the first of the longest windows that are tried do not count: a traverse begins once, and
how early a setting answers then says nothing of how well it recognizes. Only if the difference is above 0 in 97.5 % of
the bootstrap's draws are the tuned settings recommended.
"""

from dataclasses import dataclass

from smal.place_recognition.methods import MatchSettings
from smal.tuning.cross_validation import (
    HeldOut,
    check_folds,
    compare_held_out,
    count_held_out_answers,
    make_folds,
    with_window,
)
from smal.tuning.score_threshold import Answers, Threshold, choose_threshold, pooled
from smal.tuning.setting_search import Evaluate, SearchProgress, SearchSpace, Trials, restricted, search


@dataclass(frozen=True)
class Tried:
    """One setting and its area under the curve over all queries."""

    settings: MatchSettings
    auc: float


@dataclass(frozen=True)
class Tuning:
    """The answer.

    Parameters
    ----------
    default, tuned : MatchSettings
        Where the search began, and the best of all that was tried.
    tried : tuple of Tried
        Best first.
    alone : tuple of Tried
        Each modality alone, with the default's length and penalty.
    held_out : HeldOut
    threshold : Threshold, optional
        For the recommended settings over all queries; None if none reaches the precision.
    held_out_answers : Answers, optional
        With thresholds that each half chose for the other.
    """

    default: MatchSettings
    tuned: MatchSettings
    tried: tuple[Tried, ...]
    alone: tuple[Tried, ...]
    held_out: HeldOut
    threshold: Threshold | None
    held_out_answers: Answers | None

    @property
    def is_better(self) -> bool:
        """Whether the tuned settings beat the defaults on held-out queries by more than chance."""
        return self.held_out.difference.interval[0] > 0.0

    @property
    def recommended(self) -> MatchSettings:
        """The tuned settings if they are better, or else the defaults."""
        return self.tuned if self.is_better else self.default


def tune(
    evaluate: Evaluate,
    default: MatchSettings,
    space: SearchSpace,
    progress: SearchProgress,
    *,
    precision: float = 1.0,
    seed: int = 0,
) -> Tuning:
    """Search settings, and cross-validate the search.

    Parameters
    ----------
    evaluate : callable
        From settings to one judgement for each trial. With one trial its halves test each other; with several, half
        of one sort of trials (conditions) tests what the other half of the others chose.
    default : MatchSettings
        Where the search begins, and what is recommended unless the search finds better.
    space : SearchSpace
    progress : callable
        Called with the number of settings that have been tried, and about how many it will be.
    precision : float
        Of the answers above tau, above 0 and at most 1.
    seed : int
        Of the bootstrap.

    Raises
    ------
    ValueError
        The queries are too few, or a half has nothing to find.
    """
    trials = Trials(evaluate, progress)
    trials.expect(1 + len(space.modalities) + 3 * space.steps)
    judgements = trials.judgements(default)
    longest = max((*space.lengths, default.length))
    everything = with_window(judgements, longest)
    folds = make_folds(everything, longest)
    check_folds(judgements, folds)
    starts = [default, *space.alone(default)]
    chosen = tuple(search(trials, space, starts, fold.choosing, (2 - k) * space.steps) for k, fold in enumerate(folds))
    tuned = search(trials, space, [default, *trials.tried], everything, 0)
    held_out = compare_held_out(trials, default, chosen, folds, seed)
    better = held_out.difference.interval[0] > 0.0
    final = tuned if better else default
    trials.expect(0)
    return Tuning(
        default,
        tuned,
        tuple(sorted((Tried(one, trials.auc(one, everything)) for one in trials.tried), key=lambda one: -one.auc)),
        tuple(Tried(one, trials.auc(one, everything)) for one in space.alone(default)),
        held_out,
        choose_threshold(pooled(restricted(trials.judgements(final), everything)), precision),
        count_held_out_answers(trials, chosen if better else (default,) * len(folds), folds, precision),
    )

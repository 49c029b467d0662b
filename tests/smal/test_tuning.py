"""Tuning: what it finds, and that it does not believe what chance made."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from smal.evaluation.ground_truth import IntervalTruth, Judgement, judge
from smal.evaluation.precision_recall import PrecisionRecall
from smal.features import FeatureSettings
from smal.place_recognition.methods import METHODS, MatchSettings
from smal.tuning.cross_validation import make_folds, with_window
from smal.tuning.other_conditions import evening, overcast
from smal.tuning.recommendation import Tuning, tune
from smal.tuning.score_threshold import choose_threshold, count_answers
from smal.tuning.setting_search import SearchSpace, Trials, search
from smal.tuning.setting_trials import SettingTrials, TraversePair

FRAMES = 80
#: Of every modality so many entries vary: in more dimensions no noise hides a place.
ENTRIES = 12
HELD = FeatureSettings.of(("color", "thumbnail", "gist"))
PLAIN = MatchSettings(HELD, 3, 0.5)
SPACE = SearchSpace(HELD.modalities, (3,), (0.35, 0.5))


def ignore(_tried: int, _expected: int) -> None:
    pass


def traverses(noise: dict[str, float], seed: int = 0) -> TraversePair:
    """Make two traverses of one way: each modality of the second has noise of its own strength, relative to it."""
    rng = np.random.default_rng(seed)
    references, queries = np.zeros((2, FRAMES, HELD.size), dtype=np.float32)
    for name, where in zip(HELD.modalities, HELD.slices, strict=True):
        steps = rng.standard_normal((FRAMES + 2, ENTRIES))
        way = steps[:-2] + steps[1:-1] + steps[2:]  # neighbours resemble each other
        some = slice(where.start, where.start + ENTRIES)
        references[:, some] = way
        queries[:, some] = way + noise.get(name, 0.0) * rng.standard_normal(way.shape)
    frames = np.arange(FRAMES)
    truth = IntervalTruth(np.maximum(frames - 1, 0), np.minimum(frames + 1, FRAMES - 1), np.ones(FRAMES, bool))
    return TraversePair(references, queries, HELD, truth)


def elsewhere(pair: TraversePair, name: str) -> TraversePair:
    """Let one modality of the queries show the way from another place on: worse than noise."""
    where = dict(zip(HELD.modalities, HELD.slices, strict=True))[name]
    queries = pair.queries.copy()
    queries[:, where] = np.roll(pair.references[:, where], FRAMES // 3, axis=0)
    return replace(pair, queries=queries)


def tuned(pair: TraversePair, method: str = "smal", seed: int = 0) -> Tuning:
    return tune(SettingTrials(method, (pair,)), PLAIN, SPACE, ignore, seed=seed)


def weight_of(settings: MatchSettings, name: str) -> float:
    return dict(zip(settings.features.modalities, settings.features.weights, strict=True)).get(name, 0.0)


@pytest.mark.parametrize("method", ["smal", "nearest"])
def test_a_modality_that_misleads_loses_its_weight(method: str) -> None:
    pair = elsewhere(traverses({"color": 2.0, "thumbnail": 4.0}), "gist")
    found = tuned(pair, method)
    assert found.is_better
    assert found.recommended == found.tuned
    assert weight_of(found.tuned, "gist") < weight_of(found.tuned, "color")
    assert found.held_out.tuned.value > found.held_out.default.value + 0.2
    assert all(weight_of(one, "gist") < weight_of(one, "color") for one in found.held_out.chosen)
    assert [found.alone[place].settings.features.modalities for place in range(3)] == [(n,) for n in HELD.modalities]
    assert found.alone[0].auc > found.alone[2].auc


def test_pure_noise_counts_less_than_what_shows_the_place() -> None:
    found = tuned(traverses({"color": 1.5, "thumbnail": 60.0, "gist": 60.0}))
    assert found.is_better
    assert found.tuned.features == FeatureSettings.of(("color",))
    assert found.tried[0].settings == found.tuned
    assert found.tried[0].auc == max(one.auc for one in found.tried)


def test_perfect_defaults_are_recommended_without_a_search() -> None:
    found = tuned(traverses({}))
    assert found.default == found.tuned == found.recommended == PLAIN
    assert not found.is_better
    assert (found.held_out.default.value, found.held_out.difference.interval) == (1.0, (0.0, 0.0))
    assert len(found.tried) == 1 + len(HELD.modalities)
    assert found.threshold is not None
    assert (found.threshold.precision, found.threshold.recall) == (1.0, 1.0)


def test_same_seed_same_answer() -> None:
    pair = elsewhere(traverses({"color": 2.0, "thumbnail": 4.0}), "gist")
    first, other = tuned(pair, "nearest"), tuned(pair, "nearest", seed=1)
    assert tuned(pair, "nearest") == first
    assert other.held_out.default.interval != first.held_out.default.interval
    assert (other.tuned, other.tried) == (first.tuned, first.tried)


def test_chance_is_not_recommended() -> None:
    """Settings that are all equally good: some look better where they were chosen, hardly any elsewhere."""

    def by_chance(world: int) -> Tuning:
        def evaluate(settings: MatchSettings) -> list[Judgement]:
            weights = [round(1000 * weight_of(settings, name)) for name in HELD.modalities]
            rng = np.random.default_rng([world, settings.length, round(1000 * (settings.penalty or 0)), *weights])
            everything = np.ones(120, bool)
            return [Judgement(rng.random(120), everything, rng.random(120) < 0.7, everything, everything)]

        return tune(evaluate, PLAIN, SPACE, ignore)

    worlds = [by_chance(world) for world in range(30)]
    areas = [(found.tried[0].auc, next(t.auc for t in found.tried if t.settings == PLAIN)) for found in worlds]
    assert np.mean([best - default for best, default in areas]) > 0.05
    assert sum(found.is_better for found in worlds) <= 3
    assert abs(np.mean([found.held_out.difference.value for found in worlds])) < 0.04


def test_several_trials_test_each_other() -> None:
    """What helps under one condition and harms under the other is not recommended."""
    pairs = [
        elsewhere(traverses({one: 1.5, "thumbnail": 60.0}), other)
        for one, other in (("color", "gist"), ("gist", "color"))
    ]
    found = tune(SettingTrials("smal", tuple(pairs)), PLAIN, SPACE, ignore)
    assert [weight_of(one, "gist") < weight_of(one, "color") for one in found.held_out.chosen] == [True, False]
    assert found.held_out.tuned.value < found.held_out.default.value
    assert found.recommended == PLAIN


@given(
    judged=st.lists(st.booleans(), min_size=40, max_size=200),
    length=st.integers(1, 8),
    trials=st.integers(1, 3),
)
def test_what_tests_shares_no_frame_with_what_chose_it(judged: list[bool], length: int, trials: int) -> None:
    counts = np.array(judged)
    if counts.sum() < 4 * length:
        with pytest.raises(ValueError, match=f"too few to test what they choose: it takes {4 * length}"):
            make_folds([counts] * trials, length)
        return
    folds = make_folds([counts] * trials, length)
    tested = [np.flatnonzero(np.logical_or.reduce(fold.testing)) for fold in folds]
    assert sorted([*tested[0], *tested[1]]) == np.flatnonzero(counts).tolist()
    assert set(tested[0]).isdisjoint(tested[1])
    for fold, testing in zip(folds, tested, strict=True):
        choosing = np.flatnonzero(np.logical_or.reduce(fold.choosing))
        assert choosing.size
        assert np.abs(choosing[:, np.newaxis] - testing).min() >= length
        if trials > 1:
            assert not any(c.any() and t.any() for c, t in zip(fold.choosing, fold.testing, strict=True))


def test_every_setting_is_tried_once() -> None:
    asked: list[MatchSettings] = []
    told: list[tuple[int, int]] = []
    pair = traverses({"color": 6.0, "gist": 6.0, "thumbnail": 6.0})
    inner = SettingTrials("nearest", (pair,))

    def evaluate(settings: MatchSettings) -> list[Judgement]:
        asked.append(settings)
        return inner(settings)

    tune(evaluate, PLAIN, SPACE, lambda *counts: told.append(counts))
    assert len(asked) == len(set(asked)) > 10
    assert all(tried <= expected for tried, expected in told)
    assert told[-1] == (len(asked), len(asked))


def test_search_finds_what_no_single_modality_has() -> None:
    """Judged by a score of the weights alone, the search reaches the best of all its settings."""
    goal = {"color": 1.0, "thumbnail": 0.5}

    def evaluate(settings: MatchSettings) -> list[Judgement]:
        far = sum(abs(weight_of(settings, name) - goal.get(name, 0.0)) for name in HELD.modalities)
        far += abs((settings.penalty or 0.0) - 0.35)
        right = np.arange(100) >= 10 * far
        everything = np.ones(100, bool)
        return [Judgement(np.ones(100), everything, right, everything, everything)]

    found = search(Trials(evaluate, ignore), SPACE, [PLAIN], [np.ones(100, bool)], 0)
    assert found == MatchSettings(FeatureSettings.of(("color", "thumbnail"), (1.0, 0.5)), 3, 0.35)


@pytest.mark.parametrize("method", ["smal", "image"])
def test_sums_of_products_match_as_the_method_does(method: str) -> None:
    pair = traverses({"color": 1.0, "gist": 2.0, "thumbnail": 1.0})
    settings = MatchSettings(FeatureSettings.of(("gist", "color"), (2.0, 0.5)), METHODS[method].length, 0.35)
    fast = SettingTrials(method, (pair,)).match(0, settings)
    raw = [np.concatenate([part[:, HELD.slices[2]], part[:, HELD.slices[0]]], axis=1)
           for part in (pair.references, pair.queries)]  # fmt: skip
    slow = METHODS[method].match(raw[0], raw[1], settings, lambda _done: None)
    assert np.mean(fast.reference == slow.reference) >= 0.97
    np.testing.assert_allclose(fast.score, slow.score, atol=2e-2)
    assert PrecisionRecall.of(judge(fast, pair.truth)).auc == pytest.approx(
        PrecisionRecall.of(judge(slow, pair.truth)).auc, abs=0.01
    )


def judgements(draw: st.DrawFn) -> Judgement:
    count = draw(st.integers(2, 25))
    flags = [np.array(draw(st.lists(st.booleans(), min_size=count, max_size=count))) for _ in range(4)]
    scores = draw(st.lists(st.floats(-1.0, 1.0) | st.sampled_from([0.0, 0.5]), min_size=count, max_size=count))
    answered, right, judged, findable = flags
    judged[0] = findable[0] = True
    findable &= judged
    return Judgement(np.array(scores), answered, right & answered & findable, judged, findable)


def kept(judgement: Judgement, tau: float) -> NDArray[np.bool_]:
    return judgement.judged & judgement.answered & (judgement.score > tau)


@given(judgement=st.composite(judgements)(), precision=st.sampled_from([1.0, 0.9, 0.5]))
def test_tau_separates_and_leaves_out_no_more_than_it_must(judgement: Judgement, precision: float) -> None:
    found = choose_threshold(judgement, precision)
    # All that a threshold could do, counted by hand.
    cuts = [kept(judgement, least) for least in [-2.0, *judgement.score]]
    enough = [int(judgement.right[cut].sum()) for cut in cuts
              if cut.any() and judgement.right[cut].mean() >= precision]  # fmt: skip
    most = max(enough, default=0)
    if found is None:
        assert most == 0
        return
    given_answers = kept(judgement, found.tau)
    assert int(judgement.right[given_answers].sum()) == most > 0
    assert judgement.right[given_answers].mean() == pytest.approx(found.precision)
    assert found.precision >= precision
    assert found.recall == pytest.approx(most / judgement.findable.sum())
    counted = count_answers(judgement, found.tau)
    assert (counted.given, counted.right) == (given_answers.sum(), most)


def test_tau_has_few_decimals() -> None:
    everything = np.ones(4, bool)
    right = np.array([True, True, False, False])
    found = choose_threshold(Judgement(np.array([0.81234, 0.61234, 0.41234, 0.2]), everything, right, everything,
                                       everything), 1.0)  # fmt: skip
    assert found is not None
    assert found.tau == 0.5


@pytest.mark.parametrize("precision", [0.0, 1.01, float("nan")])
def test_a_precision_is_a_share(precision: float) -> None:
    everything = np.ones(2, bool)
    with pytest.raises(ValueError, match="a precision lies above 0"):
        choose_threshold(Judgement(np.ones(2), everything, everything, everything, everything), precision)


def test_queries_before_the_longest_window_do_not_count() -> None:
    everything = np.ones(6, bool)
    judgement = Judgement(np.ones(6), everything, everything, everything, everything)
    assert with_window([judgement], 3)[0].tolist() == [False, False, True, True, True, True]


def test_a_half_with_nothing_to_find_is_refused() -> None:
    pair = traverses({})
    first, last = pair.truth.first.copy(), pair.truth.last.copy()  # type: ignore[attr-defined]
    first[:45], last[:45] = -1, -1
    pair = replace(pair, truth=IntervalTruth(first, last, np.ones(FRAMES, bool)))
    settings = replace(PLAIN, length=15)
    with pytest.raises(ValueError, match="has nothing to find"):
        tune(SettingTrials("smal", (pair,)), settings, replace(SPACE, lengths=(15,)), ignore)


def picture() -> NDArray[np.uint8]:
    rng = np.random.default_rng(0)
    return np.kron(rng.integers(40, 216, (6, 8, 3), dtype=np.uint8), np.ones((10, 10, 1), np.uint8))


def test_other_conditions_are_what_they_say() -> None:
    image = picture()
    before = image.copy()
    dark, bright = evening(1.0).degrade(image, 0, 0), overcast(1.0).degrade(image, 0, 0)
    assert np.array_equal(image, before)
    assert dark.shape == bright.shape == image.shape
    assert dark.dtype == np.uint8
    assert dark.mean() < image.mean() < bright.mean()
    red, _, blue = dark.reshape(-1, 3).mean(axis=0) / image.reshape(-1, 3).mean(axis=0)
    assert red > blue
    half = image.shape[1] // 2
    flat = np.full_like(image, 128)
    lit = evening(1.0).degrade(flat, 0, 0)
    assert lit[:, half:].mean() > lit[:, :half].mean() + 5
    assert "gamma 1.50" in evening(1.0).meaning


def test_degradation_is_chance_of_seed_and_frame_and_grows_with_strength() -> None:
    image = picture()
    assert np.array_equal(evening(1.0).degrade(image, 3, 4), evening(1.0).degrade(image, 3, 4))
    assert not np.array_equal(evening(1.0).degrade(image, 3, 4), evening(1.0).degrade(image, 3, 5))
    assert not np.array_equal(evening(1.0).degrade(image, 3, 4), evening(1.0).degrade(image, 4, 4))
    for conditions in (evening, overcast):
        away = [np.abs(conditions(s).degrade(image, 0, 0).astype(int) - image).mean() for s in (0.3, 1.0, 3.0)]
        assert away == sorted(away)


def test_a_large_image_is_degraded_at_the_size_of_a_small_one() -> None:
    large = np.kron(picture(), np.ones((10, 10, 1), np.uint8))
    assert evening(1.0).degrade(large, 0, 0).shape == (240, 320, 3)
    flat = np.full((60, 3200, 3), 128, np.uint8)
    assert evening(1.0).degrade(flat, 0, 0).shape == (24, 320, 3)

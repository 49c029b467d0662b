"""The numbers of the report, against counts that are known."""

from __future__ import annotations

from pathlib import Path

import pytest

from services.commands.evaluation.plan import SCHEMES, Recogniser
from services.commands.evaluation.report.summary import recognised, success_of, successes
from smal.evaluation.success import wilson_interval
from tests.services.commands.evaluation.evaluated import QUERIES, SMALL, finished

(WORLD,) = SMALL.worlds


def test_areas(tmp_path: Path) -> None:
    planned, store = finished(tmp_path)
    found = {(one.recogniser.key, one.degradation): one for one in recognised(WORLD, planned, store.findings)}
    assert len(found) == 2 * 8
    ours = found["smal-5", "occluded"]
    # All answers are right, and the first frame, which no window precedes, has none.
    assert ours.curve.auc == pytest.approx(1.0)
    assert ours.auc_from_start == pytest.approx(1 - 1 / QUERIES)
    single = found["smal-1", "occluded"]
    # All are judged on the same frames: 51, from the first whole window of the longest sequence (frame 39) on. The 34
    # right answers are the surest ones.
    assert {one.judgement.score.size for one in found.values()} == {51}
    assert single.curve.auc == pytest.approx(34 / 51)
    assert single.curve.recall_at_100_precision == pytest.approx(34 / 51)
    assert single.auc_95[0] < single.curve.auc < single.auc_95[1]
    assert single.name == "single image (l = 1)"
    assert found["nearest-1", "clean"].recogniser == Recogniser("nearest", 1)


def test_schemes_come_first_and_by_length(tmp_path: Path) -> None:
    planned, store = finished(tmp_path)
    found = [(one.controller, one.length) for one in successes(WORLD, planned, store.findings)]
    schemes = [one for one in found if one[0] in SCHEMES]
    assert found[: len(schemes)] == schemes
    assert schemes == [("paper", length) for length in (1, 1, 5, 5, 20, 20)] + [("smal", 5)] * 2


def test_counts_of_searches(tmp_path: Path) -> None:
    planned, store = finished(tmp_path)
    found = successes(WORLD, planned, store.findings)
    blind = success_of(found, "paper", 1, "occluded")
    assert blind is not None
    assert (blind.found, blind.runs, blind.median_ticks) == (0, 8, None)
    ours = success_of(found, "smal", 5, "occluded")
    assert ours is not None
    assert (ours.found, ours.wilson_95) == (8, wilson_interval(8, 8))
    assert ours.median_ticks == pytest.approx(154.5)
    assert success_of(found, "smal", 7, "clean") is None

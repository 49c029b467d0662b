"""The numbers of the report, against counts that are known."""

from __future__ import annotations

from pathlib import Path

import pytest

from services.experiments.evaluation.plan import Recognizer, Trial
from services.experiments.evaluation.report.summary import recognized, success_of, successes
from smal.evaluation.success import wilson_interval
from tests.services.experiments.evaluation.evaluated import QUERIES, SMALL, finished

(WORLD,) = SMALL.worlds


def test_areas(tmp_path: Path) -> None:
    planned, store = finished(tmp_path)
    found = {(one.recognizer.key, one.degradation): one for one in recognized(WORLD, planned, store.findings)}
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
    assert found["nearest-1", "clean"].recognizer == Recognizer("nearest", 1)


def test_counts_of_searches(tmp_path: Path) -> None:
    planned, store = finished(tmp_path)
    found = successes(WORLD, planned, store.findings)
    blind = success_of(found, Trial("teach-and-repeat", 1, 1, degradation="occluded"))
    assert blind is not None
    assert (blind.found, blind.runs, blind.ended("collision"), blind.spl) == (0, 8, 8, 0.0)
    # Eight searches of 100 m in which nothing was found.
    assert blind.interventions_per_km == pytest.approx(10.0)
    assert (blind.wrong_share, blind.right_within(3.0)) == (None, None)
    ours = success_of(found, Trial("smal", 1, 1))
    assert ours is not None
    assert (ours.found, ours.wilson_95, ours.interventions_per_km) == (8, wilson_interval(8, 8), 0.0)
    assert ours.spl == pytest.approx(0.8)
    assert (ours.aside_rms_m, ours.aside_max_m) == (pytest.approx(0.5), 1.5)
    assert ours.wrong_share == pytest.approx(0.02)
    carried = success_of(found, Trial("smal", 1, 1, kidnap_tick=50))
    assert carried is not None
    assert (carried.right_within(3.0), carried.right_within(5.0), carried.spl) == ((6, 8), (7, 8), None)
    assert success_of(found, Trial("smal", 7, 1)) is None

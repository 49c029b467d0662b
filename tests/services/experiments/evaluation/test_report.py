"""The page needs nothing beside it, and what it says follows the numbers."""

import json
import re

import pytest

from services.experiments.evaluation.plan import Trial
from services.experiments.evaluation.report.page import write_page
from services.experiments.evaluation.report.summary import Success, WorldResults, results_of
from services.experiments.evaluation.results import Results
from services.experiments.evaluation.units import units
from smal.evaluation.precision_recall import wilson_interval
from tests.services.experiments.evaluation.evaluated import SMALL, finished

FIGURES = {
    "precision-recall-yard", "success-yard", "drives-yard", "route-yard",
}  # fmt: skip


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Results:
    return finished(tmp_path_factory.mktemp("evaluation"))


@pytest.fixture(scope="module")
def world(results: Results) -> WorldResults:
    return results_of(SMALL.worlds[0], units(SMALL), results.findings)


def test_report_page_is_complete_and_loads_no_network_files(
    results: Results, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("services.experiments.evaluation.report.page._DPI", 30)
    page = write_page(SMALL, results)
    text = page.read_text(encoding="utf-8")
    sources = re.findall(r'(?:src|href)="([^"]{0,22})', text)
    assert sources == ["data:image/png;base64,"] * len(FIGURES)
    assert {path.stem for path in (page.parent / "figures").iterdir()} == FIGURES
    assert "{" not in re.sub(r"<style>.*?</style>", "", text, flags=re.DOTALL), (
        "a text that was not filled in"
    )
    for said in (
        "within 1 m and 25°", "nearly everything", "35% of the frames occluded",
        "<td>9 of 10</td>", "<b>8 of 8</b>", "2.2 m at end", "<td>190, 130</td>", "0% to 32%", "64x48 pixels",
    ):  # fmt: skip
        assert said in text, said
    numbers = json.loads((page.parent / "results.json").read_text())
    searches = numbers["worlds"]["yard"]["searches"]
    assert {one["succeeded"] for one in searches if one["length"] == 20} == {0}
    assert numbers["machine_seconds"] == pytest.approx(0.5 * len(units(SMALL)), abs=0.1)


def test_areas(world: WorldResults) -> None:
    found = {(one.recognizer.title, one.degradation): one for one in world.recognized}
    assert len(found) == 2 * 5
    ours = found["Eq. 9, l = 5", "occluded"]
    single = found["single image (l = 1)", "occluded"]
    # All answers are right, and the first frame, which no window precedes, has none.
    assert ours.curve.auc == pytest.approx(1.0)
    # All are judged on the same frames: 56, from the first whole window of the longest sequence (frame 19) on. The
    # 37 right answers are the surest ones.
    assert {one.judgement.score.size for one in found.values()} == {56}
    right = int(single.judgement.right.sum())
    assert (single.curve.auc, single.curve.recall_at_100_precision) == pytest.approx(
        (right / 56, right / 56)
    )
    interval = single.figures["auc_95"]
    assert isinstance(interval, tuple)
    assert interval[0] < single.curve.auc < interval[1]


def test_counts_of_searches(world: WorldResults) -> None:
    trials = {one.trial: one for one in world.successes}

    def of(driver: str, **special: object) -> Success:
        return trials[Trial(driver, 1, 8, **special)]  # type: ignore[arg-type]

    blind = of("teach-and-repeat", degradation="occluded")
    assert (blind.succeeded, blind.runs, blind.outcomes, blind.spl) == (
        0,
        8,
        ["collision"] * 8,
        0.0,
    )
    # Eight searches of 100 m in which nothing was found.
    assert blind.interventions_per_km == pytest.approx(10.0)
    assert (blind.wrong_share, blind.right_soon) == (None, None)
    ours = of("smal")
    assert (ours.succeeded, ours.wilson_95, ours.interventions_per_km) == (
        8,
        wilson_interval(8, 8),
        0.0,
    )
    assert (ours.spl, ours.aside_rms_m, ours.aside_max_m) == pytest.approx((0.8, 0.5, 1.5))
    assert (ours.clearance_p5_m, ours.turns_per_m, ours.jerk_m_s3) == pytest.approx(
        (0.35, 0.2, 2.0)
    )
    assert ours.time_over_taught == pytest.approx(154.5 / 120.0)
    assert ours.wrong_share == pytest.approx(0.02)
    assert ours.arrival_m == pytest.approx(2.25)
    assert ours.decision_ms == (20.0, 29.0)
    carried = of("smal", kidnap_tick=50)
    assert (carried.right_soon, carried.spl, carried.time_over_taught) == ((6, 8), None, None)


def test_trial_is_left_out_when_searches_are_missing(results: Results, world: WorldResults) -> None:
    findings = {
        unit: one for unit, one in results.findings.items() if getattr(unit, "which", 0) == 0
    }
    left = results_of(SMALL.worlds[0], units(SMALL), findings)
    missing = {one.trial for one in world.successes} - {one.trial for one in left.successes}
    assert {(one.driver, one.cell) for one in missing} == {
        ("smal", "anywhere"),
        ("teach-and-repeat", "anywhere"),
    }

"""The page needs nothing beside it, shows every figure and number, and says what it does not have."""

from __future__ import annotations

import json
import re
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from services.experiments.evaluation.report.page import write_page
from services.experiments.evaluation.results import ResultStore
from services.experiments.evaluation.schedule import settings_of, units
from tests.services.experiments.evaluation.evaluated import SMALL, finished

FIGURES = {
    "precision-recall-yard", "precision-recall-lengths-yard", "area-lengths-yard", "success-yard", "drives-yard",
    "route-yard", "objective", "convergence-yard",
}  # fmt: skip


class Balanced(HTMLParser):
    """Checks that every element that is opened is closed."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag not in {"meta", "img"}:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("evaluation")
    planned, store = finished(folder)
    return write_page(SMALL, planned, store)


def test_the_page_is_whole_and_refers_to_nothing_outside(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    parser = Balanced()
    parser.feed(text)
    assert parser.open == []
    sources = re.findall(r'(?:src|href)="([^"]{0,22})', text)
    assert len(sources) == len(FIGURES)
    assert all(source.startswith("data:image/png;base64,") for source in sources)
    assert "{" not in re.sub(r"<style>.*?</style>", "", text, flags=re.DOTALL), "a text that was not filled in"


def test_what_the_page_says_is_computed_from_the_results(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    for said in (
        "within 1 m and 25°", "within 0.5 m and 15°", "nearly everything", "35% of the frames occluded",
        "8 of 8 found by SMAL against 0 of 8 by teach and repeat, SMAL is ahead",
        "<td>9 of 10</td>", "<td>190, 130</td>", "0% to 32%", "64x48 pixels",
    ):  # fmt: skip
        assert said in text, said
    numbers = json.loads((page.parent / "results.json").read_text())
    searches = numbers["worlds"]["yard"]["searches"]
    assert {one["found"] for one in searches if one["controller"] == "paper" and one["length"] == 20} == {0}
    areas = [one for one in numbers["worlds"]["yard"]["recognition"] if (one["method"], one["length"]) == ("smal", 5)]
    assert [one["auc"] for one in areas] == pytest.approx([1.0] * 4)
    assert [one["auc_from_start"] for one in areas] == pytest.approx([59 / 60] * 4)
    assert numbers["machine_seconds"] == pytest.approx(0.5 * len(units(SMALL)), abs=0.1)


@pytest.mark.parametrize("share", [0.0, 0.8, 0.97])
def test_a_page_of_what_is_done_so_far_shows_whole_series_only(share: float, tmp_path: Path) -> None:
    planned, whole = finished(tmp_path / "whole")
    rng = np.random.default_rng(round(100 * share))
    store = ResultStore(tmp_path / "part", SMALL)
    for unit in planned:
        if unit.kind in {"teach", "learn", "queries"} or rng.random() < share:
            store.add(unit, whole.findings[unit.key], 0.5)
    text = write_page(SMALL, planned, store).read_text(encoding="utf-8")
    parser = Balanced()
    parser.feed(text)
    assert f"<b>Not all is done:</b> {len(store.findings)} of {len(planned)} units" in text
    numbers = json.loads((store.folder / "results.json").read_text())
    names = [name for name, _ in settings_of(SMALL.worlds[0].trials[0])]
    shown = {tuple(one[name] for name in names) for one in numbers["worlds"]["yard"]["searches"]}
    searches = [unit for unit in planned if unit.kind == "search"]
    torn = {tuple(one[name] for name in names) for one in searches if one.key not in store.findings}
    every = {tuple(one[name] for name in names) for one in searches}
    assert shown == every - torn

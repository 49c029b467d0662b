"""Results last: every finished unit is kept, a torn line is not, and nothing is mixed with results of another plan."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from services.experiments.evaluation.results import ResultStore
from services.experiments.evaluation.schedule import units
from services.kit.errors import JobError, UsageError
from tests.services.experiments.evaluation.evaluated import SMALL, finding

PLANNED = units(SMALL)


def test_what_was_added_is_there_again(tmp_path: Path) -> None:
    store = ResultStore(tmp_path, SMALL)
    for unit in PLANNED[:10]:
        store.add(unit, finding(unit), 1.23456)
    again = ResultStore(tmp_path, SMALL)
    assert again.findings == store.findings
    assert again.findings[PLANNED[0].key] == {**finding(PLANNED[0]), "cpu_s": 1.235}
    with pytest.raises(ValueError, match="is done already"):
        again.add(PLANNED[3], {}, 0.0)


@pytest.mark.parametrize("cut", [1, 2, 30])
def test_a_torn_last_line_is_dropped_and_made_again(tmp_path: Path, cut: int) -> None:
    store = ResultStore(tmp_path, SMALL)
    for unit in PLANNED[:4]:
        store.add(unit, finding(unit), 1.0)
    lines = tmp_path / "units.jsonl"
    lines.write_bytes(lines.read_bytes()[:-cut])
    torn = ResultStore(tmp_path, SMALL)
    assert set(torn.findings) == {unit.key for unit in PLANNED[:3]}
    torn.add(PLANNED[3], finding(PLANNED[3]), 2.0)
    assert set(ResultStore(tmp_path, SMALL).findings) == {unit.key for unit in PLANNED[:4]}


def test_a_line_in_the_middle_that_is_none_is_named(tmp_path: Path) -> None:
    ResultStore(tmp_path, SMALL).add(PLANNED[0], {}, 1.0)
    with (tmp_path / "units.jsonl").open("a") as file:
        file.write('{"key": 1\n')
    with pytest.raises(JobError, match=r"units.jsonl: line 2 is no result; delete it"):
        ResultStore(tmp_path, SMALL)


def test_a_folder_of_another_plan_is_refused(tmp_path: Path) -> None:
    ResultStore(tmp_path, SMALL)
    with pytest.raises(UsageError, match=r"--out .*: holds results of the plan 'small' \(small, now full\)"):
        ResultStore(tmp_path, replace(SMALL, name="full"))
    with pytest.raises(UsageError, match="holds results with another plan fingerprint"):
        ResultStore(tmp_path, replace(SMALL, patience=1.5))


def test_drives_whose_file_is_gone_are_made_again_only_where_somebody_needs_them(tmp_path: Path) -> None:
    store = ResultStore(tmp_path, SMALL)
    for unit in PLANNED:
        files = ["lost"] if unit.kind in {"teach", "learn"} else []
        store.add(unit, {**finding(unit), "files": files}, 1.0)
    store.forget_missing(PLANNED)
    assert len(store.findings) == len(PLANNED), "all is done, nobody needs them"
    (needing,) = [unit for unit in PLANNED if unit.kind == "objective"]
    del store.findings[needing.key]
    store.forget_missing(PLANNED)
    forgotten = {unit.key for unit in PLANNED} - set(store.findings)
    learned = [unit for unit in PLANNED if unit.key in needing.needs and unit.kind == "learn"]
    taught = {unit.key for unit in PLANNED if unit.kind == "teach"}
    assert forgotten == {needing.key, learned[0].key} | taught

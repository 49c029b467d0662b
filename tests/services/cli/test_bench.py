"""``smal bench``: which benchmarks there are, how they are started, and every mistake as one line."""

from __future__ import annotations

from pathlib import Path

import pytest

from services.cli import bench
from services.kit.process import EXIT_FAILED, EXIT_USAGE
from tests.services.cli.conftest import Mistake, Smal

PROBE = """
import json, os, sys
print(json.dumps([sys.argv[1:], {k: v for k, v in os.environ.items() if k.endswith("_NUM_THREADS")}, os.getcwd()]))
sys.exit(3)
"""


def test_a_benchmark_runs_with_its_threads_fixed_where_the_user_is(
    tmp_path: Path, smal: Smal, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "checkout" / "tests" / "benchmarks"
    (folder / "probe").mkdir(parents=True)
    for package in (folder.parent, folder, folder / "probe"):
        (package / "__init__.py").touch()
    (folder / "probe" / "benchmark.py").touch()
    (folder / "__main__.py").write_text(PROBE)
    (folder / "helper.py").write_text("X = 1\n")
    monkeypatch.setattr(bench, "FOLDER", folder)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "tests").mkdir()
    assert bench.benchmarks(folder) == ["probe"]
    status, said, wrong = smal("bench", "probe", "--json", "a.json", "--speed", "7", "--quick", "--threads", "2")
    assert (status, wrong) == (3, "")
    assert '["probe", "--json", "a.json", "--speed", "7", "--quick"]' in said
    assert said.count('_NUM_THREADS": "2"') >= 4
    assert str(tmp_path) in said


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (["juggling"], f"no benchmark 'juggling'; known are: {', '.join(bench.benchmarks(bench.FOLDER))}"),
        (["recognition", "--json", "."], "--json .: is a folder; give the name of a file"),
        (["recognition", "--json", "no/where.json"], "--json no/where.json: no folder no"),
        (["recognition", "--out", "file"], "--out file: is a file, not a folder"),
        (["recognition", "--fast"], "unrecognized arguments: --fast"),
    ],
)  # fmt: skip
def test_every_mistake_is_one_line(
    arguments: list[str], line: str, tmp_path: Path, mistake: Mistake, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").touch()
    assert mistake(EXIT_USAGE, "bench", *arguments) == f"smal: {line}\n"


def test_without_a_checkout_there_are_none(tmp_path: Path, mistake: Mistake, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bench, "FOLDER", tmp_path / "tests" / "benchmarks")
    assert "benchmarks need a checkout of the project" in mistake(EXIT_FAILED, "bench", "recognition")

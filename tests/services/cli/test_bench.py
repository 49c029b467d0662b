"""``smal bench``: which benchmarks there are, how they are started, and every mistake as one line."""

from __future__ import annotations

from pathlib import Path

import pytest

from services.cli import bench
from tests.services.cli.conftest import Smal

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
    assert said.count('_NUM_THREADS": "2"') >= 3
    assert str(tmp_path) in said

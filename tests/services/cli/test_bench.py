"""``smal bench``: how a benchmark is started."""

import os
from pathlib import Path

import pytest

from services.cli import bench
from tests.services.cli.conftest import Smal


def test_a_benchmark_takes_this_process_with_its_threads_fixed(
    tmp_path: Path, smal: Smal, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "tests" / "benchmarks" / "probe").mkdir(parents=True)
    (tmp_path / "tests" / "benchmarks" / "probe" / "benchmark.py").touch()
    monkeypatch.setattr(bench, "CHECKOUT", tmp_path)
    begun: list[tuple[list[str], dict[str, str]]] = []
    monkeypatch.setattr(os, "execve", lambda _path, command, environment: begun.append((command, environment)))
    assert smal("bench", "probe", "--json", "a.json", "--speed", "7", "--quick", "--threads", "2")[0] == 0
    ((command, environment),) = begun
    assert command[-6:] == ["probe", "--json", "a.json", "--speed", "7", "--quick"]
    assert all(environment[name] == "2" for name in bench.THREADS)
    assert environment["PYTHONPATH"].startswith(str(tmp_path))
    assert "known are: probe" in smal("bench", "none")[2]

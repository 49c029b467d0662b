"""The benchmark of recognition from end to end, at sizes that take a second."""

import json
from pathlib import Path

import pytest

from tests.benchmarks.recognition import benchmark as recognition

TINY = recognition.Plan(n=40, lengths=(1, 5), features=64, queries=2, repetitions=1, peers=((20, 5),))


def test_everything_is_measured(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(recognition, "QUICK", TINY)
    file, out = tmp_path / "results.json", tmp_path / "pictures"
    recognition.main(["--quick", "--json", str(file), "--out", str(out)])
    results = json.loads(file.read_text())
    assert [one["l"] for one in results["matching"]] == [1, 5]
    for one in results["matching"]:
        assert 0.0 < one["ratio"] <= one["ratio_worst"]
        assert one["converged"]
        assert one["duality_gap"] <= 1e-4
    assert [one["peer"] for one in results["peers"]] == ["Algorithm 2", "CVXPY"]
    assert all(one["excess"] < 1e-4 and one["times_faster"] > 0.0 for one in results["peers"])
    assert (out / "convergence.png").stat().st_size > 10_000
    assert "Time over one float32 product" in capsys.readouterr().out

"""The benchmark of recognition from end to end, at sizes that take a second."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.benchmarks.recognition import benchmark as recognition
from tests.benchmarks.recognition.datasets import Recorded, Synthetic
from tests.benchmarks.results import LeftOutError, write_json

TINY = recognition.Plan(
    n=40, lengths=(1, 5), features=64, queries=2, repetitions=1, whole_runs=((20, 5),), one_solves=((40, 5),),
    cvxpy=((20, 5),), figure=(20, 5),
)  # fmt: skip


def random_streams(seed: int, *frames: int) -> list[Any]:
    rng = np.random.default_rng(seed)
    return [rng.standard_normal((count, 64), dtype=np.float32) / np.float32(8.0) for count in frames]


def test_everything_is_measured(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Random streams stand in place of drives."""
    drives = Recorded("campus", random_streams(1, 12, 25), random_streams(2, 30))
    monkeypatch.setattr(recognition, "QUICK", TINY)
    monkeypatch.setattr(recognition, "campus", lambda *_: drives)
    file, out = tmp_path / "results.json", tmp_path / "pictures"
    recognition.main(["--quick", "--json", str(file), "--out", str(out)])
    results = json.loads(file.read_text())
    assert [(one["dataset"], one["l"]) for one in results["matching"]] == [
        ("synthetic", 1), ("synthetic", 5), ("campus", 1), ("campus", 5)
    ]  # fmt: skip
    for one in results["matching"]:
        assert one["product_ms"] > 0.0
        assert 0.0 < one["ratio"] <= one["ratio_worst"]
        assert one["converged"]
        assert one["duality_gap"] <= 1e-4
    assert [(one["n"], one["times_faster"] > 0.0) for one in results["algorithm2"]] == [(20, True), (40, True)]
    assert all(abs(one["relative_difference"]) < 1e-4 for one in results["cvxpy"])
    assert (out / "convergence.png").stat().st_size > 10_000
    assert results["left_out"] == {}
    text = capsys.readouterr().out
    assert "Time over one float32 product" in text
    assert str(file) in text


def test_what_does_not_run_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    def no_driver(*_: object) -> Recorded:
        raise LeftOutError("failed to find a rendering device")

    monkeypatch.setattr(recognition, "campus", no_driver)
    results = recognition.benchmark(TINY, None, None)
    assert results["left_out"] == {"campus": "failed to find a rendering device"}


def test_the_synthetic_video_is_as_alike_as_it_says() -> None:
    problem = Synthetic(300, 4096).problem(300, 10, 4)
    templates = problem.templates
    assert templates.flags.f_contiguous
    np.testing.assert_allclose(np.linalg.norm(templates, axis=0), 1.0, atol=1e-5)
    assert np.mean(np.sum(templates[:, 1:] * templates[:, :-1], axis=0)) == pytest.approx(0.9, abs=0.01)
    best = [float(np.max(templates.T @ query[:, 0])) for query in problem.queries]
    assert np.mean(best) == pytest.approx(0.8, abs=0.03)


def test_results_are_whole_or_not_there(tmp_path: Path) -> None:
    file = tmp_path / "results.json"
    with pytest.raises(ValueError, match="not JSON compliant"):
        write_json(file, {"ratio": float("nan")})
    write_json(file, {"ratio": 1.0})
    assert [path.name for path in tmp_path.iterdir()] == ["results.json"]

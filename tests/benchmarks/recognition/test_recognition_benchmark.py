"""The benchmark of recognition from end to end, at sizes that take a second."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from tests.benchmarks.recognition import benchmark as recognition
from tests.benchmarks.recognition.datasets import Recorded, Synthetic
from tests.benchmarks.recognition.images import ImageFolder
from tests.benchmarks.recognition.matching import problems
from tests.benchmarks.recognition.plan import Plan
from tests.benchmarks.results import LeftOutError, table, write_json

TINY = Plan(
    sizes=(20, 40), lengths=(1, 5), features=64, queries=2, repetitions={10**9: 1}, growth_from=20,
    whole_runs=((20, 5),), one_solves=((40, 5),), cvxpy=((20, 5),), figure=(20, 5),
)  # fmt: skip


def random_streams(seed: int, *frames: int) -> list[Any]:
    rng = np.random.default_rng(seed)
    return [rng.standard_normal((count, 64), dtype=np.float32) / np.float32(8.0) for count in frames]


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    """Give a folder of two traverses; the second sees what the first saw, with noise."""
    rng = np.random.default_rng(5)
    for k in range(14):
        image = np.kron(rng.integers(0, 256, (6, 8, 3), dtype=np.uint8), np.ones((8, 8, 1), dtype=np.uint8))
        noise = rng.integers(-20, 20, image.shape)
        for name, pixels in (("ref", image), ("query", np.clip(image + noise, 0, 255).astype(np.uint8))):
            (tmp_path / "photos" / name).mkdir(parents=True, exist_ok=True)
            assert cv2.imwrite(str(tmp_path / "photos" / name / f"frame{k}.png"), pixels)
    return tmp_path / "photos"


@pytest.fixture
def tiny(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make the quick run tiny, with random streams in place of drives."""
    monkeypatch.setattr(recognition, "QUICK", TINY)
    monkeypatch.setattr(
        recognition, "campus", lambda *_: Recorded("campus", random_streams(1, 12, 25), random_streams(2, 30))
    )


@pytest.mark.usefixtures("tiny")
def test_everything_is_measured(tmp_path: Path, photos: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "results.json"
    out = tmp_path / "pictures"
    recognition.main(["--quick", "--json", str(file), "--out", str(out), "--images", str(photos)])
    results = json.loads(file.read_text())
    assert {one["dataset"].partition(":")[0] for one in results["matching"]} == {"synthetic", "campus", "real"}
    for one in results["matching"]:
        assert one["product_seconds"] > 0.0
        assert one["template_bytes"] == 4 * one["m"]
        assert 0.0 < one["ratio"] <= one["ratio_worst"]
        assert one["converged"]
        assert one["duality_gap"] <= 1e-4
    assert [one["l"] for one in results["growth"]] == [1, 5]
    assert [(one["n"], one["times_faster"] > 0.0) for one in results["algorithm2"]] == [(20, True), (40, True)]
    assert all(abs(one["relative_difference"]) < 1e-4 for one in results["cvxpy"])
    assert (out / "convergence.png").stat().st_size > 10_000
    assert set(results["left_out"]) == {f"sizes of {ImageFolder.find(photos).name}"}
    text = capsys.readouterr().out
    assert "Time over one float32 product" in text
    assert "not measured" in text
    assert str(file) in text


def test_what_does_not_run_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    def no_driver(*_: object) -> Recorded:
        raise LeftOutError("failed to find a rendering device")

    monkeypatch.setattr(recognition, "campus", no_driver)
    choice = recognition.Choice(parts=("matching",), datasets=("campus", "real"))
    results = recognition.benchmark(TINY, choice)
    assert results["left_out"]["dataset campus"] == "failed to find a rendering device"
    assert "--images" in results["left_out"]["dataset real"]
    assert "synthetic" in results["left_out"]["growth"]
    assert results["left_out"]["part cvxpy"] == "not among the chosen parts"
    assert {one["verdict"] for one in results["targets"]} == {"not measured"}


def test_the_synthetic_video_is_as_alike_as_it_says() -> None:
    problem = Synthetic(300, 4096).problem(300, 10, 4)
    templates = problem.templates
    assert templates.flags.f_contiguous
    np.testing.assert_allclose(np.linalg.norm(templates, axis=0), 1.0, atol=1e-5)
    assert np.mean(np.sum(templates[:, 1:] * templates[:, :-1], axis=0)) == pytest.approx(0.9, abs=0.01)
    best = [float(np.max(templates.T @ query[:, 0])) for query in problem.queries]
    assert np.mean(best) == pytest.approx(0.8, abs=0.03)


def test_recorded_sequences_overlap_only_where_frames_are_scarce() -> None:
    recorded = Recorded("drives", random_streams(1, 30, 12), random_streams(2, 25))
    assert (recorded.problem(40, 5, 3).n, recorded.problem(40, 5, 3).stride) == (40, 5)
    scarce = recorded.problem(80, 5, 3)
    assert (scarce.n, scarce.stride) == (80, 2)
    np.testing.assert_array_equal(scarce.templates[:, 5], recorded.taught[0][2])
    assert all(query.shape == (64, 5) for query in scarce.queries)
    sizes = [(n, one if isinstance(one, str) else one.n) for n, one in problems(recorded, (40, 500, 5000), (5,), 3)]
    assert sizes == [(40, 40), (500, 170), (5000, "l = 5, n = 5,000: its frames make 170 templates at most")]
    ((_, reason),) = problems(recorded, (40,), (30,), 3)
    assert reason == "l = 30: no held-out stream of drives has 30 frames"


def test_half_of_a_folder_s_images_are_queries(tmp_path: Path) -> None:
    for name in ("2.jpg", "10.jpg", "1.jpg", "11.jpg", "notes.txt"):
        (tmp_path / name).touch()
    found = ImageFolder.find(tmp_path)
    assert (found.templates.frames, found.queries.frames) == (("1.jpg", "2.jpg"), ("10.jpg", "11.jpg"))
    with pytest.raises(LeftOutError, match=r"no image can be read: 1\.jpg"):
        found.read()


def test_results_are_whole_or_not_there(tmp_path: Path) -> None:
    file = tmp_path / "results.json"
    with pytest.raises(ValueError, match="not JSON compliant"):
        write_json(file, {"ratio": float("nan")})
    write_json(file, {"ratio": 1.0})
    assert [path.name for path in tmp_path.iterdir()] == ["results.json"]
    assert table("Title", [{"name": "a", "n": 2_000}, {"name": "bc", "n": None}]) == (
        "\nTitle\nname      n\na     2,000\nbc        -\n"
    )

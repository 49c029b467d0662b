"""The benchmark of the decision latency from end to end: a learned corridor, and a drive along it."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from services.cli.options import Camera
from services.kit.errors import JobError, UsageError
from smal.features import FeatureSettings
from tests import corridor
from tests.benchmarks.latency import benchmark as latency
from tests.benchmarks.latency.drives import drives, resized
from tests.benchmarks.latency.load import Load
from tests.benchmarks.latency.results import judge, judge_watched, summary
from tests.corridor import LENGTH
from tests.services.chain import picture

FRAMES = 12


@pytest.fixture
def taught(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[Path, Path]:
    """Give a model, and a folder of recordings of which only the name is real."""

    def again(_folder: Path) -> Iterator[tuple[list[np.ndarray], list[corridor.Pose]]]:
        way = [corridor.pose(frame) for frame in range(FRAMES)]
        while True:
            yield [corridor.view(*pose) for pose in way], way

    monkeypatch.setattr(latency, "drives", again)
    (tmp_path / "drive.mcap").touch()
    # The services of the benchmark make the usual features.
    monkeypatch.setattr(corridor, "FEATURES", FeatureSettings())
    corridor.model.__wrapped__().save(tmp_path / "corridor.smal")
    return tmp_path / "corridor.smal", tmp_path


@pytest.mark.system
def test_every_frame_is_answered(taught: tuple[Path, Path], capsys: pytest.CaptureFixture[str]) -> None:
    model, recordings = taught
    file = recordings / "results.json"
    latency.main(["--model", str(model), "--recordings", str(recordings), "--json", str(file), "--ticks", "18",
                  "--camera", "64x48", "--scheme", "filter", "--scheme", "paper", "--stages"])  # fmt: skip
    results: dict[str, Any] = json.loads(file.read_text())
    assert [(one["camera"], one["scheme"]) for one in results["cases"]] == [("64x48", "filter"), ("64x48", "paper")]
    # A drive of 12 frames and one of 6; the paper's scheme decides at every third frame. On a busy machine some
    # decisions may be late.
    for one, due in zip(results["cases"], (FRAMES + 6, (FRAMES + 6) // LENGTH), strict=True):
        assert one["templates"] > 0
        assert one["frames"]["count"] == 18
        assert one["decisions"]["due"] == due
        assert 1 <= one["decisions"]["count"] <= one["decisions"]["due"]
        assert one["frames"]["missing"] < 18
        assert one["stages"].keys() == {"observation", "state"}
        assert set(one["cores"]) == {"bench", *latency.SERVICES}
    assert "64x48" in capsys.readouterr().out


@pytest.mark.system
def test_pages_that_watch_are_measured_against_none(
    taught: tuple[Path, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    model, recordings = taught
    file = recordings / "results.json"
    latency.main(["--model", str(model), "--recordings", str(recordings), "--json", str(file), "--ticks", "12",
                  "--camera", "64x48", "--scheme", "filter", "--watchers", "3"])  # fmt: skip
    results: dict[str, Any] = json.loads(file.read_text())
    assert [one["watchers"] for one in results["cases"]] == [0, 3]
    assert all(1 <= one["decisions"]["count"] <= 12 for one in results["cases"])
    assert all("console" in one["cores"] for one in results["cases"])
    assert "3 watchers over none" in results["targets"][-1]["target"]
    assert "3 watchers over none" in capsys.readouterr().out


def test_the_cost_of_watchers_is_judged() -> None:
    quiet = {"scheme": "filter", "camera": "64x48", "decisions": summary([0.01, 0.02])}
    for slower, verdict in ((1.1, "met"), (1.3, "not met")):
        watched = {"watchers": 10, "decisions": summary([0.01, slower * 0.02])}
        assert judge_watched(quiet, watched)["verdict"] == verdict
    assert judge_watched(quiet, {"watchers": 10, "decisions": summary([0.01, None])})["verdict"] == "not met"


def test_a_frame_without_a_command_took_for_ever() -> None:
    answered = summary([0.01] * 96 + [None] * 4)
    assert (answered["p95_ms"], answered["p99_ms"], answered["missing"]) == (10.0, None, 4)
    case: dict[str, Any] = {"templates": 9000, "keyframes": 500, "camera": "320x240", "scheme": "filter"}
    assert judge(case | {"decisions": answered})["verdict"] == "met"
    assert judge(case | {"decisions": summary([0.01, None])})["verdict"] == "not met"
    assert judge(case | {"decisions": summary([])})["verdict"] == "not met"


def test_images_are_brought_to_a_size() -> None:
    frames = [picture(1), picture(2)]
    assert resized(frames, None) is frames
    assert resized(frames, Camera(64, 48)) is frames
    assert [one.shape for one in resized(frames, Camera(128, 96))] == [(96, 128, 3)] * 2


def test_mistakes_are_said(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="both --model and --recordings"):
        latency.main(["--model", "x.smal"])
    (tmp_path / "empty.mcap").touch()
    with pytest.raises(JobError, match="empty"):
        next(drives(tmp_path))


def test_the_load_of_a_process_that_is_gone_is_not_known() -> None:
    load = Load({"gone": 2**30})
    with load.watched():
        pass
    assert load.cores() == {"gone": None}

"""The benchmark of the decision latency from end to end: a learned corridor, and a drive along it."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from services.commands.errors import JobError, UsageError
from services.commands.options import Camera
from tests.benchmarks.latency import benchmark as latency
from tests.benchmarks.latency.drives import drives, resized
from tests.benchmarks.latency.load import Load
from tests.benchmarks.latency.results import judge, summary
from tests.services.chain import LENGTH, picture, save_model

FRAMES = 12


@pytest.fixture
def corridor(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[Path, Path]:
    """Give a model, and a folder of recordings of which only the name is real."""

    def again(_folder: Path) -> Iterator[list[np.ndarray]]:
        while True:
            yield [picture(place) for place in range(FRAMES)]

    monkeypatch.setattr(latency, "drives", again)
    (tmp_path / "drive.mcap").touch()
    return save_model(tmp_path / "corridor.smal"), tmp_path


@pytest.mark.system
def test_every_frame_is_answered(corridor: tuple[Path, Path], capsys: pytest.CaptureFixture[str]) -> None:
    model, recordings = corridor
    file = recordings / "results.json"
    latency.main(["--model", str(model), "--recordings", str(recordings), "--json", str(file), "--ticks", "18",
                  "--camera", "64x48", "--camera", "96x72", "--stride", "1", "--stages"])  # fmt: skip
    results: dict[str, Any] = json.loads(file.read_text())
    assert [(one["camera"], one["stride"]) for one in results["cases"]] == [("64x48", 1), ("96x72", 1)]
    for one in results["cases"]:
        assert one["templates"] > 0
        assert one["frames"]["count"] == 18
        # A drive of 12 frames and one of 6, with a decision at every frame that completes a sequence. On a busy
        # machine some may be late.
        assert one["decisions"]["due"] == FRAMES + 6 - 2 * (LENGTH - 1)
        assert 1 <= one["decisions"]["count"] <= one["decisions"]["due"]
        assert one["frames"]["missing"] < 18
        assert one["stages"].keys() == {"observation", "state"}
        assert set(one["cores"]) == {"bench", *latency.SERVICES}
    assert "64x48" in capsys.readouterr().out


def test_a_frame_without_a_command_took_for_ever() -> None:
    answered = summary([0.01] * 96 + [None] * 4)
    assert (answered["p95_ms"], answered["p99_ms"], answered["missing"]) == (10.0, None, 4)
    case: dict[str, Any] = {"templates": 9000, "camera": "320x240", "stride": 1}
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

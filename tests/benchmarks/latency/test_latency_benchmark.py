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
@pytest.mark.parametrize("watchers", [[0], [0, 3]])
def test_every_frame_is_answered(
    taught: tuple[Path, Path], watchers: list[int], capsys: pytest.CaptureFixture[str]
) -> None:
    """A drive of 12 frames and one of 6; on a busy machine some decisions may be late."""
    model, recordings = taught
    file = recordings / "results.json"
    latency.main(["--model", str(model), "--recordings", str(recordings), "--json", str(file), "--ticks", "18",
                  "--camera", "64x48", "--watchers", str(watchers[-1])])  # fmt: skip
    results: dict[str, Any] = json.loads(file.read_text())
    assert [(one["camera"], one["watchers"]) for one in results["cases"]] == [("64x48", count) for count in watchers]
    for one in results["cases"]:
        assert one["keyframes"] > 0
        assert one["frames"] == 18
        assert one["missing"] < 18
    assert "64x48" in capsys.readouterr().out


def test_a_frame_without_a_command_took_for_ever() -> None:
    answered = latency.summary([0.01] * 96 + [None] * 4)
    assert (answered["p50_ms"], answered["p95_ms"], answered["missing"]) == (10.0, 10.0, 4)
    assert latency.summary([0.01, None])["p95_ms"] is None
    assert latency.summary([])["p50_ms"] is None


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

"""The benchmark of the decision latency from end to end: a learned corridor, and a drive along it."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from smal.features import FeatureSettings
from tests import corridor
from tests.benchmarks.latency import benchmark as latency

FRAMES = 12


@pytest.mark.system
def test_every_frame_is_answered(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A drive of 12 frames and one of 6; on a busy machine some decisions may be late."""

    def again(_folder: Path) -> Iterator[tuple[list[np.ndarray], list[corridor.Pose]]]:
        way = [corridor.pose(frame) for frame in range(FRAMES)]
        while True:
            yield [corridor.view(*pose) for pose in way], way

    monkeypatch.setattr(latency, "drives", again)
    (tmp_path / "drive.mcap").touch()
    # The services of the benchmark make the usual features.
    monkeypatch.setattr(corridor, "FEATURES", FeatureSettings())
    corridor.model.__wrapped__().save(tmp_path / "corridor.smal")
    file = tmp_path / "results.json"
    latency.main(["--model", str(tmp_path / "corridor.smal"), "--recordings", str(tmp_path), "--json", str(file),
                  "--ticks", "18", "--camera", "96x72", "--watchers", "3"])  # fmt: skip
    results: dict[str, Any] = json.loads(file.read_text())
    assert [(one["camera"], one["watchers"]) for one in results["cases"]] == [("96x72", count) for count in (0, 3)]
    for one in results["cases"]:
        assert one["keyframes"] > 0
        assert one["frames"] == 18
        assert one["missing"] < 18

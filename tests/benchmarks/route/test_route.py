"""The benchmark of a long route, on a short one."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from smal.settings import SETTINGS
from tests.benchmarks.route import benchmark as route


def test_the_way_is_followed_and_timed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(route, "SETTINGS", SETTINGS.__class__(most_components=200))
    file = tmp_path / "results.json"
    route.main(["--quick", "--metres", "30", "60", "--json", str(file)])
    case, longer = json.loads(file.read_text())["cases"]
    assert (case["keyframes"], longer["keyframes"]) == (41, 81)
    assert 0.0 < case["p50_ms"] <= case["p95_ms"]
    assert longer["most_lost"] < 0.5

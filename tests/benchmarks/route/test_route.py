"""The benchmark of a long route, on a short one."""

import json
from pathlib import Path

import pytest

from smal.settings import SETTINGS
from tests.benchmarks.route import benchmark as route
from tests.smal.synthetic_world import COLOR, COLUMNS, ROWS


def test_the_way_is_followed_and_timed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(route, "SETTINGS", SETTINGS.__class__(most_components=200))
    monkeypatch.setattr(route, "IMAGE", (ROWS, COLUMNS))
    monkeypatch.setattr(route, "_FEATURES", COLOR)
    file = tmp_path / "results.json"
    route.main(["--quick", "--metres", "30", "60", "--json", str(file)])
    found = json.loads(file.read_text())
    assert [one["frames"] for one in found["learned"]] == [80, 120]
    assert all(one["cpu_s"] > 0.0 for one in found["learned"])
    case, longer = found["cases"]
    assert (case["keyframes"], longer["keyframes"]) == (41, 81)
    assert 0.0 < case["p50_ms"] <= case["p95_ms"]
    assert longer["most_lost"] < 0.5

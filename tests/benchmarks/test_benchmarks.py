"""Benchmarks from end to end, at sizes that take seconds."""

import json
from pathlib import Path

import pytest

from smal.keyframes import MapConfig
from tests.benchmarks import places, route
from tests.benchmarks.bus import benchmark as bus
from tests.benchmarks.recognition import benchmark as recognition
from tests.smal.synthetic_world import COLOR, COLUMNS, ROWS


@pytest.mark.long
def test_large_traverses_are_measured(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(places, "QUICK", (60,))
    monkeypatch.setattr(places, "FEATURES", places.FEATURES.of(["thumbnail"]))
    file = tmp_path / "results.json"
    places.main(["--quick", "--json", str(file)])
    results = json.loads(file.read_text())
    assert results["traverses"][0]["right"] > 0.8
    assert [one["verdict"] for one in results["targets"]] == ["met", "met"]


@pytest.mark.long
@pytest.mark.system
@pytest.mark.parametrize(
    ("flags", "ways", "targets"),
    [(["--secure"], ["open", "secure"] * 2, 2), (["--flood"], ["alone", "flooded"], 1)],
)
def test_the_bus_is_measured(
    flags: list[str], ways: list[str], targets: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    monkeypatch.setattr(bus, "QUICK", bus.Plan(turns=1, messages=20 if flags == ["--flood"] else 2))
    file = tmp_path / "results.json"
    bus.main(["--quick", "--json", str(file), *flags])
    results = json.loads(file.read_text())
    assert [one["way"] for one in results["messages"]] == ways
    # From one process to another, on one clock.
    assert all(10.0 < one["median_us"] <= one["p95_us"] < 5e6 for one in results["messages"])
    assert len(results["targets"]) == targets
    assert str(file) in capsys.readouterr().out


TINY = recognition.Plan(
    n=40,
    drives=3,
    route=10,
    lengths=(1, 5),
    features=64,
    queries=2,
    repetitions=1,
    peers=((20, 5),),
)


@pytest.mark.long
def test_recognition_is_measured(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(recognition, "QUICK", TINY)
    file = tmp_path / "results.json"
    out = tmp_path / "pictures"
    recognition.main(["--quick", "--json", str(file), "--out", str(out)])
    results = json.loads(file.read_text())
    assert [one["l"] for one in results["matching"]] == [1, 5, 1, 5]
    for one in results["matching"]:
        assert 0.0 < one["ratio"] <= one["ratio_worst"]
        assert one["converged"]
        assert one["duality_gap"] <= 1e-4
    assert [one["peer"] for one in results["peers"]] == ["Algorithm 2", "CVXPY"]
    assert all(one["excess"] < 1e-4 and one["times_faster"] > 0.0 for one in results["peers"])
    assert (out / "convergence.png").stat().st_size > 10_000
    assert "Time over one float32 product" in capsys.readouterr().out


@pytest.mark.long
def test_the_way_is_followed_and_timed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(route, "MAP_CONFIG", MapConfig(most_components=200))
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

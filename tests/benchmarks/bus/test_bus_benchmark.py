"""The benchmark of the bus from end to end, at a size that takes seconds."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from tests.benchmarks.bus import benchmark as bus
from tests.benchmarks.bus.messages import CASES

WAYS = ["plain", "same publisher", "callback", "ours", "built"]


@pytest.mark.system
def test_everything_is_measured(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(bus, "QUICK", bus.Plan(turns=2, messages=1))
    file = tmp_path / "results.json"
    bus.main(["--quick", "--json", str(file)])
    results: dict[str, Any] = json.loads(file.read_text())
    assert [one["message"] for one in results["messages"]] == [case.name for case in CASES]
    for one in results["messages"]:
        assert list(one["ways"]) == WAYS
        assert one["ways"]["plain"]["ratio"] == 1.0
        for figures in one["ways"].values():
            # From one process to another, on one clock.
            assert 10.0 < figures["median_us"] <= figures["p95_us"] < 5e6
            assert figures["processor_us"] > 10.0
            assert figures["ratio"] > 0.0
    assert [one["limit"] for one in results["targets"]] == ["at most 1.3", *["at most 3"] * 4]
    text = capsys.readouterr().out
    assert "frame 1024x768, ours over plain" in text
    assert str(file) in text


@pytest.mark.system
def test_commands_are_timed_beside_a_flood(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bus, "QUICK", bus.Plan(turns=5, messages=5))
    file = tmp_path / "results.json"
    bus.main(["--quick", "--flood", "--json", str(file)])
    results: dict[str, Any] = json.loads(file.read_text())
    assert [one["commands"].split()[0] for one in results["commands"]] == ["alone", "beside"]
    assert all(0.01 < one["median ms"] <= one["p95 ms"] for one in results["commands"])


@pytest.mark.system
def test_what_certificates_cost_is_measured(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bus, "QUICK", bus.Plan(turns=2, messages=1))
    file = tmp_path / "results.json"
    bus.main(["--quick", "--secure", "--json", str(file)])
    results: dict[str, Any] = json.loads(file.read_text())
    assert [one["message"] for one in results["messages"]] == [case.name for case in CASES]
    assert all(one["ways"][way]["median_us"] > 10.0 for one in results["messages"] for way in ("open", "secure"))
    assert [one["limit"] for one in results["targets"]] == ["at most 1.5 times the time", "at most 0.3 ms more"]

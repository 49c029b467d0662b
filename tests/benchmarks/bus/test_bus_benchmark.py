"""The benchmark of the bus from end to end, at a size that takes seconds."""

import json
from pathlib import Path

import pytest

from tests.benchmarks.bus import benchmark as bus


@pytest.mark.system
@pytest.mark.parametrize(
    ("flags", "ways", "targets"), [(["--secure"], ["open", "secure"] * 2, 2), (["--flood"], ["alone", "flooded"], 1)]
)
def test_everything_is_measured(
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

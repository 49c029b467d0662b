"""The benchmark of large traverses from end to end, at sizes that take a second."""

import json
from pathlib import Path

import pytest

from tests.benchmarks.places import benchmark as places


def test_everything_is_measured(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(places, "QUICK", (60,))
    monkeypatch.setattr(places, "FEATURES", places.FEATURES.of(["thumbnail"]))
    file = tmp_path / "results.json"
    places.main(["--quick", "--json", str(file)])
    results = json.loads(file.read_text())
    assert results["traverses"][0]["right"] > 0.8
    assert [one["verdict"] for one in results["targets"]] == ["met", "met"]

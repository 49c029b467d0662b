"""The benchmark of rendering from end to end, in small pictures."""

from __future__ import annotations

import pytest

from tests.benchmarks.rendering import benchmark as rendering
from tests.benchmarks.rendering.towns import field, town


@pytest.mark.rendering
def test_scenes_are_measured_against_the_trivial_one(monkeypatch: pytest.MonkeyPatch) -> None:
    # The two that the benchmark takes need fifteen seconds of processor time before their first frames.
    monkeypatch.setattr(rendering, "_STOCK_SHADERS", ("trivial",))
    results = rendering.benchmark({"trivial": field(), "again": field(), "town": town(7)}, 8, (160, 120))
    first, again, _ = results["frames"]
    assert first["ratio"] == 1.0
    assert 0.3 < again["ratio"] < 3
    assert [stock["shader"] for stock in results["stock"]] == ["trivial"]
    assert results["stock"][0]["ms"] > 0

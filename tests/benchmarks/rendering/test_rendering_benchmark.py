"""The towns that are rendered, and what is made of the times."""

from __future__ import annotations

import numpy as np
import pytest
import shapely

from services.simulator.world.route import plan_route
from services.simulator.world.terrain import Terrain
from tests.benchmarks.rendering import benchmark as rendering
from tests.benchmarks.rendering.benchmark import Plan, _over_stock, as_text, benchmark
from tests.benchmarks.rendering.towns import field, town


@pytest.mark.parametrize("count", [1, 7, 60, 400])
def test_a_town_has_as_many_houses_as_asked_for_and_a_way_between_them(count: int) -> None:
    world = town(count)
    assert isinstance(world.place, Terrain)
    houses = [building.footprint for building in world.place.buildings]
    assert len(houses) == count
    assert shapely.union_all(houses).area == pytest.approx(sum(house.area for house in houses))
    assert shapely.box(*world.place.bounds).covers(shapely.union_all(houses))
    route = plan_route(world, (world.start.x, world.start.y))
    np.testing.assert_allclose(route[-1], (world.victim.x, world.victim.y))


@pytest.mark.rendering
def test_a_scene_beside_itself_takes_the_same_time(monkeypatch: pytest.MonkeyPatch) -> None:
    # The two that the benchmark takes need fifteen seconds of processor time before their first frames.
    monkeypatch.setattr(rendering, "_STOCK_SHADERS", ("trivial",))
    results = benchmark({"trivial": field(), "again": field()}, Plan(turns=8, sizes=((160, 120),), poses=4))
    first, again = results["frames"]
    assert (first["ratio"], first["processor_ratio"]) == (1.0, 1.0)
    assert 0.3 < again["processor_ratio"] < 3
    assert again["best_ms"] <= again["median_ms"]
    assert results["targets"] == []
    assert [stock["shader"] for stock in results["stock"]] == ["trivial"]
    assert all(stock["processor_ms"] > 0 and stock["median_ms"] > 0 for stock in results["stock"])
    over = _over_stock(results)[0]["again / it"]
    assert over == pytest.approx(again["median_ms"] / results["stock"][0]["median_ms"])
    assert "again / it" in as_text(results)

"""Houses that lie on each other: the work grows with their number, not with its square."""

from typing import Any

import numpy as np
import pytest
import shapely

from services.simulator.world import load_world, route
from services.simulator.world.place import Solid
from services.simulator.world.route import Obstacles
from tests.services.simulator.map_text import MapText

HOUSES = 5_000


class CountingTree(shapely.STRtree):
    """A tree that counts what its queries find."""

    found = 0

    def query(self, *what: Any, **how: Any) -> Any:
        found = super().query(*what, **how)
        CountingTree.found += found.shape[-1]
        return found


@pytest.fixture
def pile(monkeypatch: pytest.MonkeyPatch, tmp_path: Any) -> Obstacles:
    """Give thousands of houses at one place, each a little larger than the last."""
    monkeypatch.setattr(route, "STRtree", CountingTree)
    chart = MapText(100.0)
    chart.box(40.0, 40.0, 10.0, 10.0, building="house")
    chart.way([(-90.0, 0.0), (90.0, 0.0)], highway="residential")
    chart.node((-60.0, 0.0), **{"smal:role": "start", "direction": "90"})
    chart.node((60.0, 2.0), **{"smal:role": "victim"})
    place = load_world(chart.write(tmp_path / "one.osm")).place
    sizes = np.linspace(10.0, 12.0, HOUSES)
    houses = [
        Solid(shapely.box(-40 - size, -40 - size, -40 + size, -40 + size), 0.0, 6.0, opaque=True)
        for size in sizes
    ]
    CountingTree.found = 0
    return Obstacles(place, houses)


def test_query_finds_few_houses_when_all_lie_on_each_other(pile: Obstacles) -> None:
    rng = np.random.default_rng(1)
    starts = rng.uniform(-50.0, -30.0, (200, 1, 2))
    segments = np.concatenate([starts, starts + 1.0], axis=1)
    assert not pile.are_clear(segments, 0.7).any()
    assert not pile.in_sight(segments).any()
    assert not any(pile.is_free(x, y) for x, y in starts[:, 0].tolist())
    assert CountingTree.found < 600 * 100  # In each of 600 queries all 5,000 houses were found.


def test_query_finds_the_nearest_house_when_houses_overlap(pile: Obstacles) -> None:
    # The largest house reaches from 52 to 28 m west of the middle.
    assert pile.is_free(-27.0, -40.0, 0.9)
    assert not pile.is_free(-27.0, -40.0, 1.1)
    assert pile.clearance(-27.0, -40.0) == pytest.approx(1.0)
    clear = pile.are_clear(
        np.array([[(-27.0, -40.0), (-20.0, -40.0)], [(-29.0, -40.0), (-20.0, -40.0)]]), 0.5
    )
    assert clear.tolist() == [True, False]

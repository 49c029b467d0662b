"""Houses that lie on each other: the work grows with their number, not with its square."""

from typing import Any

import numpy as np
import pytest
import shapely

from services.simulator.world import load_world, route
from services.simulator.world.place import Solid
from services.simulator.world.route import Obstacles

HOUSES = 5_000


class CountingTree(shapely.STRtree):
    """A tree that counts what its queries find."""

    found = 0

    def query(self, *what: Any, **how: Any) -> Any:
        found = super().query(*what, **how)
        CountingTree.found += found.shape[-1]
        return found


def test_query_finds_few_houses_when_all_lie_on_each_other(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(route, "STRtree", CountingTree)
    boxes = [shapely.box(-40 - r, -40 - r, -40 + r, -40 + r) for r in np.linspace(10, 12, HOUSES)]
    pile = Obstacles(
        load_world("campus").place, [Solid(box, 0.0, 6.0, opaque=True) for box in boxes]
    )
    CountingTree.found = 0
    rng = np.random.default_rng(1)
    starts = rng.uniform(-50.0, -30.0, (200, 1, 2))
    segments = np.concatenate([starts, starts + 1.0], axis=1)
    assert not pile.are_clear(segments, 0.7).any()
    assert not pile.in_sight(segments).any()
    assert not any(pile.is_free(x, y) for x, y in starts[:, 0].tolist())
    assert CountingTree.found < 600 * 100  # In each of 600 queries all 5,000 houses were found.

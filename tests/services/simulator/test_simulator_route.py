"""Routes: from anywhere near the roads to the victim, and never through anything."""

from __future__ import annotations

import numpy as np
import shapely
from hypothesis import example, given, settings
from hypothesis import strategies as st

from services.simulator.world import load_world
from services.simulator.world.collision import obstacles_of
from services.simulator.world.place import World, WorldError
from services.simulator.world.route import plan_route
from services.simulator.world.task import sample_start

WORLDS = {name: load_world(name) for name in ("campus", "yard")}


def solid(world: World) -> shapely.Geometry:
    """Return everything solid, independently of `collision`."""
    trunks = [shapely.Point(tree.x, tree.y).buffer(tree.trunk_radius_m) for tree in world.place.trees]
    walls = [building.footprint for building in world.place.buildings]
    return shapely.union_all([*trunks, *walls, *(barrier.line for barrier in world.place.barriers)])


ROAD_POINTS = np.concatenate([shapely.get_coordinates(road.line) for road in WORLDS["campus"].place.roads])
SOLID = {name: solid(world) for name, world in WORLDS.items()}


@given(name=st.sampled_from(sorted(WORLDS)), seed=st.integers(0, 2**32 - 1), recovery=st.booleans())
@settings(max_examples=150, deadline=None)
def test_a_route_touches_nothing_and_ends_at_the_victim(name: str, seed: int, recovery: bool) -> None:
    world = WORLDS[name]
    start = sample_start(world, np.random.default_rng(seed), "recovery" if recovery else "run")
    route = plan_route(world, (start.x, start.y))
    np.testing.assert_allclose(route[0], (start.x, start.y))
    np.testing.assert_allclose(route[-1], (world.victim.x, world.victim.y))
    assert shapely.LineString(route).distance(SOLID[name]) >= WORLDS[name].robot.radius_m


@given(x=st.floats(-99, 99), y=st.floats(-99, 99))
@example(x=5e-324, y=5e-324)
@settings(max_examples=200, deadline=None)
def test_from_anywhere_the_way_is_free_or_missing_but_never_through_a_wall(x: float, y: float) -> None:
    try:
        route = plan_route(WORLDS["campus"], (x, y))
    except WorldError:
        # Cut off are the insides of things, their edges, and corners that see no road within 40 m.
        seen = obstacles_of(WORLDS["campus"].place).are_clear(
            np.array([[(x, y), point] for point in ROAD_POINTS if np.hypot(*(point - (x, y))) < 40]).reshape(-1, 2, 2),
            0.7,
        )
        assert not seen.any()
    else:
        assert not shapely.LineString(route).intersects(SOLID["campus"])

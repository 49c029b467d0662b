"""Collisions agree with the plain definition, and are fast enough to be asked every 20 ms."""

from __future__ import annotations

import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from services.simulator.world import load_world
from services.simulator.world.collision import Obstacles

CAMPUS = load_world("campus").place
OBSTACLES = Obstacles(CAMPUS)


def brute_force(x: float, y: float) -> float:
    """Return the clearance by asking every single obstacle."""
    here = shapely.Point(x, y)
    if not here.within(shapely.box(*CAMPUS.bounds)):
        return 0.0
    distances = [here.distance(building.footprint) for building in CAMPUS.buildings]
    distances += [here.distance(barrier.line) for barrier in CAMPUS.barriers]
    distances += [here.distance(area.footprint) for area in CAMPUS.areas if area.kind == "water"]
    distances += [max(0.0, here.distance(shapely.Point(tree.x, tree.y)) - tree.trunk_radius_m) for tree in CAMPUS.trees]
    x_min, y_min, x_max, y_max = CAMPUS.bounds
    return min([*distances, x - x_min, x_max - x, y - y_min, y_max - y])


@given(x=st.floats(-103, 103), y=st.floats(-103, 103))
@settings(max_examples=300, deadline=None)
def test_clearance_is_the_distance_to_the_nearest_thing(x: float, y: float) -> None:
    expected = brute_force(x, y)
    # Trunks are polygons of 32 sides inside their circle, up to a millimetre smaller.
    assert OBSTACLES.clearance(x, y) == pytest.approx(expected, abs=2e-3)
    if abs(expected - CAMPUS.robot.radius_m) > 2e-3:
        assert OBSTACLES.is_free(x, y) == (expected > CAMPUS.robot.radius_m)

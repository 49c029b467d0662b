"""Meshes, without a renderer: roofs are closed, and what is drawn low is what the robot bumps into."""

from __future__ import annotations

import math
from typing import get_args

import numpy as np
import pytest
import shapely
from numpy.typing import NDArray
from shapely import Polygon

from services.simulator.scene.furniture import furnish
from services.simulator.scene.interiors import paint_floor
from services.simulator.scene.meshes import Mesh, merge
from services.simulator.scene.roofs import roofs
from services.simulator.scene.structures import undersides
from services.simulator.world.furniture import ROUND, Furniture, FurnitureKind
from services.simulator.world.terrain import Building, Facade, RoofShape, Terrain
from tests.services.simulator.simulator_rooms import empty_room, room_of

#: Kinds that a robot lower than their top can drive under, between legs or panels.
OPEN_BELOW = frozenset({"desk", "table"})


def crosses(mesh: Mesh) -> NDArray[np.float64]:
    """Return twice the area of every triangle times its normal, by the order of its corners, (m, 3)."""
    a, b, c = (mesh.vertices[mesh.triangles[:, corner]].astype(np.float64) for corner in range(3))
    return np.cross(b - a, c - a)


def house(footprint: Polygon, roof: RoofShape, low: float = 0.0) -> Building:
    return Building(footprint, 6.0, Facade("brick", None, 0), roof, low, 2.0)


@pytest.mark.parametrize("roof", ["gabled", "hipped"])
@pytest.mark.parametrize(
    "footprint",
    [
        Polygon([(0, 0), (20, 0), (20, 8), (8, 8), (8, 18), (0, 18)]),
        shapely.box(0, 0, 30, 30).difference(shapely.box(10, 10, 20, 20)),
        shapely.Point(0, 0).buffer(6, quad_segs=3).union(shapely.box(0, -2, 20, 2)),
    ],
)
def test_a_roof_over_any_footprint_is_closed_and_covers_it(footprint: Polygon, roof: RoofShape) -> None:
    covers, _ = roofs([house(footprint, roof)])
    areas = np.concatenate([crosses(mesh) for some in covers.values() for mesh in some]) / 2
    np.testing.assert_allclose(areas.sum(axis=0), 0, atol=1e-3)
    covered = areas[areas[:, 2] > 0, 2].sum()
    assert covered == pytest.approx(footprint.buffer(0.4, join_style="mitre").area, rel=1e-5)


def test_what_begins_above_the_ground_has_an_underside_and_the_robot_meets_its_posts() -> None:
    canopy, bridge = house(shapely.box(0, 0, 8, 6), "flat", 3.0), house(shapely.box(0, 0, 40, 30), "flat", 4.0)
    solids = Terrain("canopy", (-5.0, -5.0, 50.0, 50.0), (canopy,), (), (), (), (), 0).solids
    in_the_way = shapely.union_all([solid.shape for solid in solids if solid.low_m < 1.0 and solid.high_m == 3.0])
    assert in_the_way.area == pytest.approx(4 * math.pi * 0.1**2, rel=0.02)
    assert len(bridge.posts) == 0
    down = sum(crosses(mesh)[:, 2].sum() / 2 for mesh in undersides([canopy, bridge]))
    assert down == pytest.approx(-(8 * 6 + 40 * 30), rel=1e-6)


@pytest.mark.parametrize("kind", get_args(FurnitureKind))
def test_what_is_solid_is_drawn_and_what_is_drawn_low_is_solid(kind: FurnitureKind) -> None:
    piece = Furniture(kind, 3.0, 2.0, 0.7, 1.6, 1.6 if kind in ROUND else 0.8, 0.9)
    vertices = merge(mesh for _, mesh in furnish(piece)).vertices.astype(np.float64)
    low = vertices[vertices[:, 2] < 0.3]
    solid = shapely.union_all([part.shape for part in piece.solids if part.low_m < 0.3])
    assert shapely.intersects_xy(solid.buffer(0.012), low[:, :2]).all()
    for part in piece.solids:
        inside = vertices[shapely.intersects_xy(part.shape.buffer(0.012), vertices[:, :2])]
        assert inside[:, 2].max() >= part.high_m * 0.88
    assert (kind in OPEN_BELOW) == (solid.area < 0.9 * piece.footprint.area)


@pytest.mark.parametrize("kind", ["planks", "lino", "carpet"])
def test_every_floor_has_something_to_be_recognized_by(kind: str) -> None:
    nobody = shapely.Point(-5.0, -5.0).buffer(0.01)
    assert paint_floor(room_of(empty_room([], floor=kind)), nobody, shadows=False).std() > 3

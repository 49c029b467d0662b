"""Meshes, without a renderer: roofs are closed, and what is drawn low is what the robot bumps into."""

from __future__ import annotations

from typing import get_args

import numpy as np
import pytest
import shapely

from services.simulator.scene.furniture import furnish
from services.simulator.scene.meshes import merge
from services.simulator.world.furniture import ROUND, Furniture, FurnitureKind

#: Kinds that a robot lower than their top can drive under, between legs or panels.
OPEN_BELOW = frozenset({"desk", "table"})


@pytest.mark.parametrize("kind", get_args(FurnitureKind))
def test_what_is_solid_is_drawn_and_what_is_drawn_low_is_solid(kind: FurnitureKind) -> None:
    depth_m = 0.0 if kind in ROUND else 0.8
    piece = Furniture(kind=kind, x_m=3.0, y_m=2.0, facing_deg=40.0, width_m=1.6, depth_m=depth_m, height_m=0.9)
    vertices = merge(mesh for _, mesh in furnish(piece)).vertices.astype(np.float64)
    low = vertices[vertices[:, 2] < 0.3]
    solid = shapely.union_all([part.shape for part in piece.solids if part.low_m < 0.3])
    assert shapely.intersects_xy(solid.buffer(0.012), low[:, :2]).all()
    for part in piece.solids:
        inside = vertices[shapely.intersects_xy(part.shape.buffer(0.012), vertices[:, :2])]
        assert inside[:, 2].max() >= part.high_m * 0.88
    assert (kind in OPEN_BELOW) == (solid.area < 0.9 * piece.footprint.area)

"""Meshes and pictures, without a renderer: watertight ground, outsides outside, seamless and repeatable pictures."""

from __future__ import annotations

import numpy as np
import pytest
import shapely
from numpy.typing import NDArray

from services.simulator.scene.bodies import victim
from services.simulator.scene.facades import paint_facade
from services.simulator.scene.ground import cast_shade, ground
from services.simulator.scene.meshes import Mesh, merge
from services.simulator.scene.noise import noise
from services.simulator.scene.outdoors import SUN
from services.simulator.scene.plants import crowns
from services.simulator.scene.shapes import ball, flat, hipped_roof, tube
from services.simulator.scene.structures import clad
from services.simulator.scene.textures import Material, paint
from services.simulator.world import load_world
from services.simulator.world.terrain import Facade

CAMPUS = load_world("campus").place
MATERIALS = tuple(Material.__args__)  # type: ignore[attr-defined]


def crosses(mesh: Mesh) -> NDArray[np.float64]:
    """Return twice the area of every triangle times its normal, by the order of its corners, (m, 3)."""
    a, b, c = (mesh.vertices[mesh.triangles[:, corner]].astype(np.float64) for corner in range(3))
    return np.cross(b - a, c - a)


def test_the_ground_has_no_gap_and_no_double_layer() -> None:
    shade = cast_shade(CAMPUS, SUN, crowns(CAMPUS.trees))
    area = sum(crosses(mesh)[:, 2].sum() / 2 for mesh in ground(CAMPUS, shade).values())
    assert area == pytest.approx(shapely.box(*CAMPUS.bounds).buffer(250).area, rel=1e-4)


def test_shade_turns_normals_away_and_changes_nothing_else() -> None:
    shade = cast_shade(CAMPUS, SUN, [])
    shady, sunny = ground(CAMPUS, shade), ground(CAMPUS, shapely.Polygon())
    assert all((mesh.normals[:, 2] == 1).all() for mesh in sunny.values())
    for material, mesh in sunny.items():
        assert crosses(shady[material])[:, 2].sum() == pytest.approx(crosses(mesh)[:, 2].sum(), rel=1e-4)
    dark = merge(shady.values())
    in_shade = crosses(dark)[dark.normals[dark.triangles[:, 0], 2] < 0, 2].sum() / 2
    assert in_shade == pytest.approx(shade.intersection(shapely.box(*CAMPUS.bounds).buffer(250)).area, rel=1e-3)


def test_the_shade_of_a_tower_is_as_long_as_the_sun_says() -> None:
    tower = max(CAMPUS.buildings, key=lambda building: building.height_m)
    shade = cast_shade(CAMPUS, SUN, [])
    corner = shapely.get_coordinates(tower.footprint).max(axis=0)
    tip = corner + np.array(SUN[:2]) / -SUN[2] * tower.height_m
    assert shade.covers(shapely.Point(tip - 0.01))
    beyond = tip + np.array(SUN[:2])
    assert not shapely.union_all([tower.footprint, shapely.LineString([corner, tip])]).covers(shapely.Point(beyond))


def test_walls_face_outwards_and_have_the_height_of_their_building() -> None:
    for facade, walls in clad(CAMPUS.buildings).items():
        buildings = [building for building in CAMPUS.buildings if building.facade == facade]
        inside = shapely.union_all([building.footprint for building in buildings])
        mesh = merge([part for part in walls if part is not None])
        middles = mesh.vertices[mesh.triangles].mean(axis=1) + 0.05 * mesh.normals[mesh.triangles[:, 0]]
        assert not shapely.intersects_xy(inside, middles[:, :2]).any()
        assert mesh.vertices[:, 2].max() == pytest.approx(max(building.height_m for building in buildings), rel=1e-6)
        assert (np.einsum("ij,ij->i", crosses(mesh), mesh.normals[mesh.triangles[:, 0]]) > 0).all()


@pytest.mark.parametrize(
    "mesh",
    [
        ball((1, 2, 3), (1, 2, 0.5), 6),
        tube((0, 0, 0), (0, 0, 2), (0.3, 0.1)),
        tube((0, 0, 0), (1, 1, 0), (0.3, 0.3)),
        hipped_roof(shapely.box(0, 0, 8, 5), 3.0, 0.6, 4.0),
        hipped_roof(shapely.box(0, 0, 5, 8), 3.0, 0.6, 4.0),
        flat(shapely.Point(0, 0).buffer(3).difference(shapely.Point(0, 0).buffer(1)), 0.0, 4.0),
        *(merge(meshes) for meshes in victim().values()),
    ],
)
def test_shapes_have_unit_normals_on_their_outside(mesh: Mesh) -> None:
    np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1.0, atol=1e-5)
    facing = np.einsum("ij,ij->i", crosses(mesh), mesh.normals[mesh.triangles].mean(axis=1))
    assert (facing > -1e-6).all()
    turned = mesh.flipped()
    np.testing.assert_allclose(crosses(turned), -crosses(mesh), atol=1e-6)


@pytest.mark.parametrize("material", MATERIALS)
def test_pictures_fit_the_renderer_and_repeat_without_a_seam(material: Material) -> None:
    picture = paint(material)
    assert picture.dtype == np.uint8
    assert all(size & (size - 1) == 0 for size in picture.shape[:2])
    np.testing.assert_array_equal(picture, paint(material))


def test_noise_has_no_seam() -> None:
    field = noise(np.random.default_rng(0), (256, 256), 12.0)
    inner = np.abs(np.diff(field, axis=1)).max()
    assert np.abs(field[:, 0] - field[:, -1]).max() <= inner
    assert np.abs(field[0] - field[-1]).max() <= inner
    assert (field.mean(), field.std()) == pytest.approx((0, 1), abs=1e-9)


def test_equal_facades_get_the_same_picture_and_others_do_not() -> None:
    first, again = (paint_facade(Facade("brick", None, 3)) for _ in range(2))
    other = paint_facade(Facade("brick", None, 4))
    np.testing.assert_array_equal(first[0], again[0])
    np.testing.assert_array_equal(first[1], again[1])
    assert np.mean(first[0] != other[0]) > 0.5

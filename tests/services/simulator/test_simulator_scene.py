"""Meshes and pictures, without a renderer: watertight ground, outsides outside, seamless and repeatable pictures."""

from __future__ import annotations

import math

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from shapely import Polygon, affinity

from services.simulator.scene.bodies import victim
from services.simulator.scene.culling import CELL_M, Cells, in_cells
from services.simulator.scene.facades import alike, paint_facade
from services.simulator.scene.ground import cast_shade, ground
from services.simulator.scene.meshes import Mesh, merge
from services.simulator.scene.noise import noise
from services.simulator.scene.plants import crowns
from services.simulator.scene.roofs import Cover, oblong, roofs
from services.simulator.scene.shapes import ball, flat, tube
from services.simulator.scene.structures import clad, undersides
from services.simulator.scene.surfaces import Surface
from services.simulator.scene.textures import Material, paint
from services.simulator.variation import DAY
from services.simulator.world import load_world
from services.simulator.world.terrain import Building, Facade, RoofShape, Terrain

CAMPUS = load_world("campus").place
SUN = DAY.light.direction
MATERIALS = tuple(Material.__args__)  # type: ignore[attr-defined]


def crosses(mesh: Mesh) -> NDArray[np.float64]:
    """Return twice the area of every triangle times its normal, by the order of its corners, (m, 3)."""
    a, b, c = (mesh.vertices[mesh.triangles[:, corner]].astype(np.float64) for corner in range(3))
    return np.cross(b - a, c - a)


def land(beyond_m: float) -> Polygon:
    return shapely.box(*CAMPUS.bounds).buffer(beyond_m, join_style="mitre")


def volume(meshes: list[Mesh]) -> float:
    """Return what closed meshes enclose, by the theorem of Gauss: no meaning unless they are closed."""
    found = 0.0
    for mesh in meshes:
        a, b, c = (mesh.vertices[mesh.triangles[:, corner]].astype(np.float64) for corner in range(3))
        found += float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum()) / 6
    return found


def vector_area(meshes: list[Mesh]) -> NDArray[np.float64]:
    """Return the sum of all normals times area: zero for what is closed."""
    return np.asarray(sum(crosses(mesh).sum(axis=0) for mesh in meshes) / 2)


def house(footprint: Polygon, roof: RoofShape, *, low: float = 0.0, rise: float = 2.0) -> Building:
    return Building(footprint, 6.0, Facade("brick", None, 0), roof, low, rise)


def test_the_ground_has_no_gap_and_no_double_layer() -> None:
    shade = cast_shade(CAMPUS, SUN, crowns(CAMPUS.trees))
    layers = ground(CAMPUS, shade)
    # Paint lies on top of the street, all the rest side by side.
    area = sum(crosses(mesh)[:, 2].sum() / 2 for material, mesh in layers.items() if material != "marking")
    assert area == pytest.approx(land(250).area, rel=1e-6)
    assert all((mesh.vertices[:, 2] == 0).all() for material, mesh in layers.items() if material != "marking")
    assert (layers["marking"].vertices[:, 2] > 0.005).all()


def test_shade_turns_normals_away_and_changes_nothing_else() -> None:
    shade = cast_shade(CAMPUS, SUN, [])
    shady, sunny = ground(CAMPUS, shade), ground(CAMPUS, shapely.Polygon())
    assert all((mesh.normals[:, 2] == 1).all() for mesh in sunny.values())
    for material, mesh in sunny.items():
        assert crosses(shady[material])[:, 2].sum() == pytest.approx(crosses(mesh)[:, 2].sum(), rel=1e-4)
    dark = merge(shady.values())
    in_shade = crosses(dark)[dark.normals[dark.triangles[:, 0], 2] < 0, 2].sum() / 2
    painted = crosses(shady["marking"])[shady["marking"].normals[shady["marking"].triangles[:, 0], 2] < 0, 2].sum() / 2
    assert in_shade - painted == pytest.approx(shade.intersection(land(250)).area, rel=1e-4)


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


@settings(deadline=None, max_examples=40)
@given(
    st.floats(3, 40), st.floats(3, 40), st.floats(0, math.tau), st.sampled_from(["gabled", "hipped"]), st.floats(0.5, 6)
)
def test_a_roof_over_a_rectangle_is_closed_and_has_the_volume_of_its_shape(
    long: float, across: float, turn: float, roof: RoofShape, rise: float
) -> None:
    footprint = affinity.rotate(shapely.box(0, 0, long, across), turn, use_radians=True)
    covers, gables = roofs([house(footprint, roof, rise=rise)])
    meshes = [mesh for some in covers.values() for mesh in some] + list(gables.values())
    np.testing.assert_allclose(vector_area(meshes), 0, atol=1e-3)
    length, width = max(long, across) + 0.8, min(long, across) + 0.8
    above = rise * width * (length / 2 if roof == "gabled" else (3 * length - width) / 6)
    assert volume(meshes) == pytest.approx(above + 0.15 * length * width, rel=1e-3)
    assert max(mesh.vertices[:, 2].max() for mesh in meshes) == pytest.approx(6 + rise, rel=1e-6)
    assert set(gables) == ({0} if roof == "gabled" else set())
    # The ridge runs along the longer side: only then are the upright ends across the shorter one.
    if roof == "gabled":
        assert np.abs(crosses(gables[0])).sum() > 0
        span = np.linalg.norm(np.ptp(gables[0].vertices[:3, :2], axis=0))
        assert span == pytest.approx(width, rel=1e-3)


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
    covers, gables = roofs([house(footprint, roof)])
    assert not gables
    assert oblong(footprint) is None
    meshes = [mesh for some in covers.values() for mesh in some]
    np.testing.assert_allclose(vector_area(meshes), 0, atol=1e-3)
    seen = sum(crosses(mesh)[crosses(mesh)[:, 2] > 0, 2].sum() / 2 for mesh in meshes)
    assert seen == pytest.approx(footprint.buffer(0.4, join_style="mitre").area, rel=1e-5)
    assert volume(meshes) > 0.15 * footprint.area


def test_a_courtyard_has_walls_and_no_roof() -> None:
    court = shapely.box(10, 10, 20, 20)
    building = house(shapely.box(0, 0, 30, 30).difference(court), "flat")
    covers, _ = roofs([building])
    inside = court.buffer(-0.5)
    for mesh in (mesh for some in covers.values() for mesh in some):
        middles = mesh.vertices[mesh.triangles].mean(axis=1)
        assert not shapely.intersects_xy(inside, middles[:, :2]).any()
    around = [mesh for part in clad([building]).values() for mesh in part if mesh is not None]
    area = sum(np.linalg.norm(crosses(mesh), axis=1).sum() / 2 for mesh in around)
    assert area == pytest.approx(6.0 * (120 + 40), rel=1e-5)
    np.testing.assert_allclose(vector_area(around), 0, atol=1e-3)


def test_what_begins_above_the_ground_has_an_underside_and_posts_if_small() -> None:
    canopy, bridge, hall = (
        house(shapely.box(0, 0, x, y), "flat", low=low) for x, y, low in ((8, 6, 3.0), (40, 30, 4.0), (8, 6, 0.0))
    )
    assert len(canopy.posts) == 4
    assert shapely.contains_xy(canopy.footprint, canopy.posts).all()
    assert len(bridge.posts) == len(hall.posts) == 0
    solids = Terrain("canopy", (-5.0, -5.0, 50.0, 50.0), (canopy,), (), (), (), (), 0).solids
    in_the_way = shapely.union_all([solid.shape for solid in solids if solid.low_m < 1.0 and solid.high_m == 3.0])
    assert in_the_way.area == pytest.approx(4 * math.pi * 0.1**2, rel=0.02)
    assert shapely.contains_xy(in_the_way, canopy.posts).all()
    down = sum(crosses(mesh)[:, 2].sum() / 2 for mesh in undersides([canopy, bridge, hall]))
    assert down == pytest.approx(-(8 * 6 + 40 * 30), rel=1e-6)
    walls = merge([mesh for part in clad([canopy]).values() for mesh in part if mesh is not None])
    assert walls.vertices[:, 2].min() == 3.0


def test_a_roof_wears_the_colour_of_its_tags() -> None:
    red = Building(shapely.box(0, 0, 9, 6), 5.0, Facade("brick", None, 0), "hipped", roof_colour=(200, 40, 40))
    covers, _ = roofs([red, house(shapely.box(20, 0, 29, 6), "hipped")])
    colours = {cover.colour for cover in covers if cover.material == "tiles"}
    assert None in colours
    assert any(colour is not None and np.abs(np.subtract(colour, (200, 40, 40))).max() <= 16 for colour in colours)
    assert Cover("trim") in covers


def test_many_facades_become_few_that_look_alike_and_few_stay() -> None:
    rng = np.random.default_rng(0)
    colours = [(int(r), int(g), int(b)) for r, g, b in rng.integers(0, 256, (1000, 3))]
    many = [Facade(("brick", "wood", "glass")[k % 3], colour, k % 997) for k, colour in enumerate(colours)]
    found = alike(many)
    assert len(set(found.values())) <= 64
    for wanted, painted in found.items():
        assert painted.style == wanted.style
        assert wanted.colour is not None
        assert painted.colour is not None
        assert np.abs(np.subtract(painted.colour, wanted.colour)).max() <= 64
    few = many[:40]
    assert alike(few) == {facade: facade for facade in few}


def test_cells_hold_every_triangle_once_in_their_boxes() -> None:
    wide = Surface(merge([ball((x, y, 3.0), (2, 2, 2), 4) for x in range(-900, 900, 90) for y in (-300, 0, 400)]),
                   paint("leaves"))  # fmt: skip
    cells = in_cells([wide])
    assert len(cells.surfaces) > 10
    pieces = [piece.mesh for some in cells.surfaces for piece in some]
    assert sum(len(mesh.triangles) for mesh in pieces) == len(wide.mesh.triangles)
    assert volume(pieces) == pytest.approx(volume([wide.mesh]), rel=1e-4)
    for some, (low, high) in zip(cells.surfaces, cells.boxes, strict=True):
        for piece in some:
            assert (piece.mesh.vertices >= low - 1e-4).all()
            assert (piece.mesh.vertices <= high + 1e-4).all()
    small = Surface(ball((0, 0, 0), (CELL_M / 4,) * 3, 4), paint("leaves"))
    assert len(in_cells([small]).surfaces) == 1


@settings(deadline=None, max_examples=60)
@given(st.floats(-300, 300), st.floats(-300, 300), st.floats(0, math.tau), st.floats(-0.4, 0.4))
def test_no_cell_is_hidden_that_holds_a_point_in_view(x: float, y: float, heading: float, pitch: float) -> None:
    rng = np.random.default_rng(0)
    low = rng.uniform(-500, 500, (200, 3)) * (1, 1, 0)
    cells = Cells(((),) * 200, np.stack([low, low + rng.uniform(1, 80, (200, 3))], axis=1))
    cos, sin = math.cos(heading), math.sin(heading)
    ahead = np.array([cos * math.cos(pitch), sin * math.cos(pitch), math.sin(pitch)])
    left = np.array([-sin, cos, 0.0])
    axes = np.stack([ahead, left, np.cross(ahead, left)])
    eye, tangents = np.array([x, y, 1.2]), (0.77, 0.58)
    shown = cells.seen(eye, axes, tangents, 400.0)
    points = cells.boxes[:, 0, None] + rng.uniform(0, 1, (200, 50, 3)) * np.ptp(cells.boxes, axis=1)[:, None]
    seen = (points - eye) @ axes.T
    depth = seen[..., 0]
    inside = (depth > 0) & (np.abs(seen[..., 1]) < tangents[0] * depth) & (np.abs(seen[..., 2]) < tangents[1] * depth)
    inside &= np.linalg.norm(points - eye, axis=-1) < 400
    assert set(np.flatnonzero(inside.any(axis=1))) <= set(shown)
    away = [np.linalg.norm(np.clip(eye, *cells.boxes[number]) - eye) for number in shown]
    assert away == sorted(away)
    assert len(shown) < 200

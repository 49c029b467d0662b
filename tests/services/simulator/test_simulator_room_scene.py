"""A room's meshes and pictures, without a renderer: furniture fills what it says, floor and walls close the room."""

from __future__ import annotations

import math
from typing import get_args

import cv2
import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from services.simulator.robots import RESCUEBOT, TURTLEBOT, RobotModel
from services.simulator.scene import bodies, indoors
from services.simulator.scene.finishes import Finish, surfaces
from services.simulator.scene.fittings import hang, walls
from services.simulator.scene.furniture import furnish
from services.simulator.scene.interiors import floor_light, paint_floor
from services.simulator.scene.meshes import Mesh, merge
from services.simulator.scene.nao import nao
from services.simulator.scene.pictures import Face, paint_face
from services.simulator.scene.rendering import _NEAR_M
from services.simulator.scene.textures import paint
from services.simulator.scene.turtlebot import plate_radius_m, tag
from services.simulator.variation import DAY
from services.simulator.world.furniture import ROUND, Furniture, FurnitureKind
from services.simulator.world.place import Pose
from services.simulator.world.room_file import VICTIM_RADIUS_M
from tests.services.simulator.simulator_rooms import empty_room, indoor, room_of

INDOOR = indoor()
ROOM = room_of(INDOOR)
KINDS = get_args(FurnitureKind)
#: Kinds that a robot lower than their top can drive under, between legs or panels.
OPEN_BELOW = frozenset({"desk", "table"})
NOBODY = shapely.Point(-5.0, -5.0).buffer(0.01)
MADE = [
    *(mesh for piece in ROOM.furniture for _, mesh in furnish(piece)),
    *(mesh for meshes in nao().values() for mesh in meshes),
    *(mesh for meshes in bodies.robot(TURTLEBOT).values() for mesh in meshes),
    *(mesh for fitting in ROOM.fittings for _, mesh in hang(fitting, ROOM)),
]


def crosses(mesh: Mesh) -> NDArray[np.float64]:
    """Return twice the area of every triangle times its normal, by the order of its corners, (m, 3)."""
    a, b, c = (mesh.vertices[mesh.triangles[:, corner]].astype(np.float64) for corner in range(3))
    return np.cross(b - a, c - a)


@pytest.mark.parametrize("mesh", MADE, ids=range(len(MADE)))
def test_triangles_are_seen_from_outside(mesh: Mesh) -> None:
    np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1.0, atol=1e-5)
    facing = np.einsum("ij,ij->i", crosses(mesh), mesh.normals[mesh.triangles].mean(axis=1))
    assert (facing > -1e-9).all()


@given(
    kind=st.sampled_from(KINDS), heading=st.floats(-math.pi, math.pi), width_m=st.floats(0.8, 2.5),
    depth_m=st.floats(0.5, 1.2), height_m=st.floats(0.5, 1.8),
)  # fmt: skip
@settings(max_examples=120, deadline=None)
def test_furniture_fills_the_footprint_and_the_height_that_it_states(
    kind: FurnitureKind, heading: float, width_m: float, depth_m: float, height_m: float
) -> None:
    piece = Furniture(kind, 3.0, 2.0, heading, width_m, width_m if kind in ROUND else depth_m, height_m)
    mesh = merge(mesh for _, mesh in furnish(piece))
    vertices = mesh.vertices.astype(np.float64)
    # Corners of pots and feet are polygons about circles; a desk's screen is above its board.
    low = vertices[vertices[:, 2] <= height_m + 1e-4]
    assert shapely.intersects_xy(piece.footprint.buffer(0.012), low[:, :2]).all()
    assert low[:, 2].min() == pytest.approx(0.0, abs=1e-3)
    assert low[:, 2].max() == pytest.approx(height_m, rel=0.02)
    hull = shapely.MultiPoint(low[:, :2]).convex_hull
    assert hull.area >= (0.4 if kind in ROUND else 0.9) * piece.footprint.area


@pytest.mark.parametrize("kind", KINDS)
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


def test_the_floor_and_the_ceiling_cover_the_room_and_the_walls_look_inwards() -> None:
    scene = indoors.build(ROOM, INDOOR.victim, DAY.light, shadows=False)
    floor, ceiling = scene.still[-1].mesh, scene.still[-2].mesh
    assert crosses(floor)[:, 2].sum() / 2 == pytest.approx(48.0)
    assert crosses(ceiling)[:, 2].sum() / 2 == pytest.approx(-48.0), "seen from below only"
    assert (floor.vertices[:, 2] == 0).all()
    assert ceiling.vertices[:, 2] == pytest.approx(ROOM.wall_height_m)
    for surface in walls(ROOM):
        to_middle = np.array([4.0, 3.0, 1.4]) - surface.mesh.vertices
        assert (np.einsum("ij,ij->i", to_middle, surface.mesh.normals) > 0).all()
    areas = sorted(float(np.linalg.norm(crosses(surface.mesh), axis=1).sum()) / 2 for surface in walls(ROOM))
    assert areas == pytest.approx([6 * 2.8, 6 * 2.8, 8 * 2.8, 8 * 2.8])


def test_what_hangs_on_a_wall_is_in_front_of_it_and_readable() -> None:
    for fitting in ROOM.fittings:
        (_, face), _ = hang(fitting, ROOM)
        distance = shapely.distance(shapely.points(face.vertices[:, :2]), shapely.box(*ROOM.bounds).exterior)
        assert (distance > 0.002).all()
        assert (distance < 0.04).all()
        assert shapely.intersects_xy(shapely.box(*ROOM.bounds), face.vertices[:, :2]).all()
        # From inside, the picture's left is on the left: u grows along the wall's direction.
        along = face.vertices[:, :2] @ np.array(ROOM.wall_frame(fitting.wall).right)
        assert np.corrcoef(along, face.uvs[:, 0])[0, 1] == pytest.approx(1.0, abs=1e-4)
        assert np.corrcoef(face.vertices[:, 2], face.uvs[:, 1])[0, 1] == pytest.approx(-1.0, abs=1e-4)


def test_things_keep_light_off_the_floor_beside_and_under_them() -> None:
    crate = {"kind": "crate", "x_m": 2.0, "y_m": 1.5, "width_m": 0.6, "depth_m": 0.6, "height_m": 0.5}
    table = {"kind": "table", "x_m": 4.0, "y_m": 3.5, "width_m": 1.2, "depth_m": 1.2, "height_m": 0.7}
    light = floor_light(room_of(empty_room([crate, table])), NOBODY)
    rows, columns = light.shape

    def at(x: float, y: float) -> float:
        return float(light[int((5.0 - y) / 5.0 * rows), int(x / 6.0 * columns)])

    assert at(2.33, 1.5) < 0.7 < at(2.6, 1.5) < at(3.0, 1.5)
    assert at(4.0, 3.5) < 0.75, "under the table"
    assert at(3.0, 2.5) > 0.97
    assert at(0.02, 2.5) < 0.7, "beside the wall"
    feet = floor_light(room_of(empty_room([crate, table])), shapely.Point(3.0, 2.5).buffer(0.08))
    assert feet[rows // 2, columns // 2] < 0.7


def test_without_shadows_the_floor_is_the_same_everywhere() -> None:
    bare = paint_floor(room_of(empty_room([])), NOBODY, shadows=False)
    crate = {"kind": "crate", "x_m": 2.0, "y_m": 1.5, "width_m": 0.6, "depth_m": 0.6, "height_m": 0.5}
    np.testing.assert_array_equal(bare, paint_floor(room_of(empty_room([crate])), NOBODY, shadows=False))
    assert (paint_floor(room_of(empty_room([crate])), NOBODY, shadows=True) <= bare).all()


@pytest.mark.parametrize("kind", ["planks", "lino", "carpet"])
def test_every_floor_has_some_structure(kind: str) -> None:
    picture = paint_floor(room_of(empty_room([], floor=kind)), NOBODY, shadows=False)
    assert all(size & (size - 1) == 0 for size in picture.shape[:2])
    assert 3 < picture.std() < 40


@pytest.mark.parametrize("face", get_args(Face))
def test_faces_are_repeatable_and_their_variants_differ(face: Face) -> None:
    picture = paint_face(face, 1, None)
    assert (picture.shape, picture.dtype) == ((512, 512, 3), np.uint8)
    np.testing.assert_array_equal(picture, paint_face(face, 1, None))
    assert (picture != paint_face(face, 2, None)).any()


def test_a_colour_is_the_mean_of_what_wears_it() -> None:
    assert Finish("fabric", (111, 60, 40)).picture().mean(axis=(0, 1)) == pytest.approx([111, 60, 40], abs=1.5)
    np.testing.assert_array_equal(Finish("wood").picture(), paint("wood"))


def test_equal_pieces_share_their_pictures() -> None:
    crates = [piece for piece in ROOM.furniture if piece.kind == "crate"]
    assert len(surfaces(furnish(crates[0]))) == len(surfaces([*furnish(crates[0]), *furnish(crates[1])]))


def test_the_victim_is_a_small_humanoid_that_stands_on_the_floor() -> None:
    mesh = merge(mesh for meshes in nao().values() for mesh in meshes)
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    assert high[2] == pytest.approx(0.58, abs=0.01)
    assert low[2] == pytest.approx(0.0, abs=0.01)
    assert np.hypot(mesh.vertices[:, 0], mesh.vertices[:, 1]).max() <= VICTIM_RADIUS_M
    # The same on both sides.
    assert low[1] == pytest.approx(-high[1], abs=1e-5)


@pytest.mark.parametrize("model", [TURTLEBOT, RESCUEBOT])
def test_the_robot_is_within_its_stated_size(model: RobotModel) -> None:
    parts = [mesh for meshes in bodies.robot(model).values() for mesh in meshes]
    marker = tag(model)
    vertices = merge([*parts, *([] if marker is None else [marker.mesh])]).vertices
    assert vertices[:, 2].min() >= -1e-6
    if model is TURTLEBOT:
        assert np.hypot(vertices[:, 0], vertices[:, 1]).max() <= model.radius_m + 1e-6
        assert vertices[:, 2].max() == pytest.approx(0.43)
        assert np.hypot(parts[0].vertices[:, 0], parts[0].vertices[:, 1]).max() > 0.16


def test_nothing_of_the_turtlebot_is_before_its_camera() -> None:
    """Whatever is nearer than a camera's near plane, in any direction that it may shake to, is not drawn."""
    marker = tag(TURTLEBOT)
    assert marker is not None
    parts = [mesh for meshes in bodies.robot(TURTLEBOT).values() for mesh in meshes]
    vertices = merge([*parts, marker.mesh]).vertices
    eye = np.array([TURTLEBOT.camera.ahead_m, 0.0, TURTLEBOT.camera.height_m])
    for pitch in np.radians((-4.0, 0.0, 4.0)):
        ahead = (vertices - eye) @ np.array([math.cos(pitch), 0.0, math.sin(pitch)])
        assert ahead.max() < _NEAR_M


def test_the_marker_is_read_upright_with_the_robots_front_up() -> None:
    """Draw the plate as seen from above with the front up, by its own texture coordinates, and read it."""
    surface = tag(TURTLEBOT)
    assert surface is not None
    assert TURTLEBOT.tag is not None
    size, metres = 400, 0.5
    x = (0.5 - (np.arange(size) + 0.5) / size)[:, None] * metres + np.zeros((1, size))
    y = (0.5 - (np.arange(size) + 0.5) / size)[None, :] * metres + np.zeros((size, 1))
    # The coordinates are linear in the place: fit them, then look every pixel up.
    vertices = np.column_stack([surface.mesh.vertices[:, :2], np.ones(len(surface.mesh.vertices))])
    uv = np.linalg.lstsq(vertices, surface.mesh.uvs, rcond=None)[0]
    u, v = (np.stack([x, y, np.ones_like(x)], axis=-1) @ uv).transpose(2, 0, 1)
    rows, columns = (np.clip(c * len(surface.picture), 0, len(surface.picture) - 1).astype(int) for c in (v, u))
    seen = np.where((np.hypot(x, y) < plate_radius_m(TURTLEBOT.tag))[..., None], surface.picture[rows, columns], 90)
    found = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)).detectMarkers(
        seen.astype(np.uint8)
    )
    corners, numbers = found[0], found[1]
    assert numbers.ravel().tolist() == [TURTLEBOT.tag.number]
    half = TURTLEBOT.tag.side_m / metres * size / 2
    expected = 200 + half * np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])
    np.testing.assert_allclose(corners[0][0], expected, atol=2.0)


def test_the_victim_is_where_the_world_says() -> None:
    scene = indoors.build(ROOM, Pose(2.0, 3.0, 0.5), DAY.light, shadows=False)
    vertices = merge(surface.mesh for surface in scene.victim).vertices
    np.testing.assert_allclose(vertices[:, :2].mean(axis=0), (2.0, 3.0), atol=0.05)
    assert scene.sky is None

"""A room as a scene: floor, walls and ceiling, furniture, what hangs on the walls, and lamps."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import shapely

from services.simulator.scene import bodies
from services.simulator.scene.finishes import Piece, surfaces
from services.simulator.scene.fittings import hang, skirting, walls
from services.simulator.scene.furniture import furnish
from services.simulator.scene.interiors import paint_ceiling, paint_floor
from services.simulator.scene.meshes import Mesh, quads
from services.simulator.scene.nao import nao
from services.simulator.scene.shapes import flat
from services.simulator.scene.surfaces import Lights, Scene, Surface, Vector, painted
from services.simulator.scene.turtlebot import tag

if TYPE_CHECKING:
    from services.simulator.variation import Daylight
    from services.simulator.world.place import Pose
    from services.simulator.world.room import Room

# Lamps above light level things most; the windows' light, from the north, keeps upright things apart from each other.
_LIGHTS: Final = Lights(
    (0.5, 0.5, 0.49),
    (
        ((0.12, 0.18, -0.97), (1.15, 1.13, 1.08)),
        ((0.25, -0.9, -0.35), (0.62, 0.66, 0.72)),
        ((-0.85, 0.35, -0.3), (0.34, 0.33, 0.3)),
    ),
)
_FEET_M: Final = 0.08
#: The ceiling's picture is four tiles of 0.6 m wide.
_CEILING_M: Final = 2.4


def build(room: Room, victim: Pose, light: Daylight, *, shadows: bool) -> Scene:
    """Make the meshes and pictures of a room with a victim standing in it."""
    pieces: list[Piece] = skirting(room)
    shining: list[Piece] = []
    for furniture in room.furniture:
        pieces += furnish(furniture)
    for fitting in room.fittings:
        face, rim = hang(fitting, room)
        (shining if fitting.kind == "window" else pieces).append(face)
        pieces.append(rim)
    standing = {material: [mesh.placed(victim) for mesh in meshes] for material, meshes in nao().items()}
    marker = tag(room.robot)
    return Scene(
        lights=_lights(light),
        # What is in front comes first, so that what is behind it need not be drawn there.
        still=(
            *surfaces(pieces),
            *surfaces(shining, glows=True),
            *walls(room),
            _ceiling(room),
            Surface(_floor(room), paint_floor(room, _feet(victim), shadows=shadows)),
        ),
        victim=painted(standing),
        robot=(*painted(bodies.robot(room.robot)), *(() if marker is None else (marker,))),
    )


def _lights(light: Daylight) -> Lights:
    """Return the room's lights, as bright and in the colour that the time of day gives them."""
    ambient, *shining = (
        _times(colour, light.lamps) for colour in (_LIGHTS.ambient, *(c for _, c in _LIGHTS.directional))
    )
    directions = [direction for direction, _ in _LIGHTS.directional]
    return Lights(ambient, tuple(zip(directions, shining, strict=True)))


def _times(colour: Vector, factors: Vector) -> Vector:
    red, green, blue = (one * other for one, other in zip(colour, factors, strict=True))
    return red, green, blue


def _feet(victim: Pose) -> shapely.Polygon:
    """Return where a standing victim keeps light off the floor."""
    return shapely.Point(victim.x, victim.y).buffer(_FEET_M)


def _floor(room: Room) -> Mesh:
    """Return the floor, its picture's upper edge in the north."""
    x_min, y_min, x_max, y_max = room.bounds
    corners = [(x_min, y_min, 0.0), (x_max, y_min, 0.0), (x_max, y_max, 0.0), (x_min, y_max, 0.0)]
    return quads([corners], [[(0.0, 1.0), (1.0, 1.0), (1.0, 0.0), (0.0, 0.0)]])


def _ceiling(room: Room) -> Surface:
    """Return the ceiling seen from below; outsides only are drawn, so a camera above it looks through."""
    level = flat(shapely.box(*room.bounds), room.wall_height_m, _CEILING_M)
    return Surface(level.flipped(), paint_ceiling(), glows=True)

"""Scene of a room: floor, walls, ceiling, furniture, wall fittings and lamps."""

from collections.abc import Iterator
from typing import Final, get_args

import cv2
import numpy as np
import shapely
from numpy.typing import NDArray

from services.simulator.scene import bodies
from services.simulator.scene.furniture import furnish
from services.simulator.scene.meshes import UPRIGHT, block, flat, front, quads
from services.simulator.scene.surfaces import (
    Finish,
    Piece,
    SceneSurfaces,
    Surface,
    Vector,
    surfaces,
)
from services.simulator.scene.textures import as_picture, coloured, layered, noise
from services.simulator.variation import Daylight
from services.simulator.world.place import Rgb
from services.simulator.world.room import Fitting, FittingKind, Room, Wall

# Lamps light mostly level surfaces; window light from the north separates upright surfaces.
_AMBIENT: Final = (0.5, 0.5, 0.49)
_LAMPS: Final[tuple[tuple[Vector, Vector], ...]] = (
    ((0.12, 0.18, -0.97), (1.15, 1.13, 1.08)),
    ((0.25, -0.9, -0.35), (0.62, 0.66, 0.72)),
    ((-0.85, 0.35, -0.3), (0.34, 0.33, 0.3)),
)
_CEILING_M: Final = 2.4  # Period of the ceiling's picture, four tiles of 0.6 m.
#: Distance of each kind from the wall.
_THICK_M: Final[dict[FittingKind, float]] = {
    "door": 0.03,
    "poster": 0.004,
    "whiteboard": 0.025,
    "window": 0.02,
}
_SKIRTING_M: Final = 0.08
_RIM: Final[dict[FittingKind, Finish]] = {
    "door": Finish("lacquer", (206, 206, 200)), "poster": Finish("white_plastic"),
    "whiteboard": Finish("aluminium"), "window": Finish("white_plastic"),
}  # fmt: skip
_PIXELS_PER_M: Final = 256
_SHADE_PIXELS_PER_M: Final = 48
_LARGEST_PX: Final = 4096
_SHEET_M: Final = 2.0
#: Strength and reach of the contact shadow beside things on the floor, and under things above it.
_CONTACT: Final = (0.5, 0.07)
_AROUND: Final = (0.42, 0.22)
_SEED: Final = 11
_LINO: Final = (150, 156, 156)


def build(room: Room, light: Daylight) -> SceneSurfaces:
    """Build the meshes and pictures of a room."""
    furniture = (piece for one in room.furniture for piece in furnish(one))
    hung = (piece for fitting in room.fittings for piece in hang(fitting, room))
    x = room.east_west_m
    y = room.north_south_m
    corners = [(0.0, 0.0, 0.0), (x, 0.0, 0.0), (x, y, 0.0), (0.0, y, 0.0)]
    tag = room.robot.tag
    return SceneSurfaces(
        *indoor_light(light),
        # Front to back, so that hidden pixels are skipped.
        still=(
            *surfaces([*furniture, *hung]),
            *walls(room),
            # Back faces are culled, so a camera above the ceiling sees through it.
            Surface(
                flat(shapely.box(*room.bounds), room.walls_m, _CEILING_M).flipped(),
                paint_ceiling(),
                glows=True,
            ),
            Surface(quads([corners], [UPRIGHT]), paint_floor(room)),
        ),
        victim=surfaces(bodies.body("nao")),
        decoys=tuple(surfaces(bodies.body(name)) for name in bodies.INDOOR_DECOYS),
        robot=(
            *surfaces(bodies.turtlebot(room.robot)),
            *(() if tag is None else (bodies.tag(tag),)),
        ),
    )


def indoor_light(light: Daylight) -> tuple[Vector, tuple[tuple[Vector, Vector], ...]]:
    """Return the ambient light, and the directions and colours of the lamps in a daylight."""
    lamps = tuple((to, _times(colour, light.lamps)) for to, colour in _LAMPS)
    return _times(_AMBIENT, light.lamps), lamps


def _times(colour: Vector, other: Vector) -> Vector:
    red, green, blue = np.multiply(colour, other).tolist()
    return red, green, blue


def walls(room: Room) -> Iterator[Surface]:
    """Yield the four painted walls."""
    for number, name in enumerate(get_args(Wall)):
        wall, length_m = room.wall(name)
        picture = paint_wall(room.wall_colour, length_m, room.walls_m, number)
        yield Surface(front((0.0, 0.0, 0.0, length_m), 0.0, room.walls_m).placed(wall), picture)


def hang(fitting: Fitting, room: Room) -> tuple[Piece, Piece]:
    """Return the face and the rim of a fitting."""
    wall, _ = room.wall(fitting.wall)
    thick = _THICK_M[fitting.kind]
    face = front(*fitting.face(thick)).placed(wall)
    rim = block(*fitting.face(thick - 0.001)).placed(wall)
    return (Finish(fitting.kind, fitting.colour, fitting.variant), face), (_RIM[fitting.kind], rim)


def paint_floor(room: Room) -> NDArray[np.uint8]:
    """Paint the whole floor with its shadows, upper edge in the north."""
    shape = _pixels(room.north_south_m), _pixels(room.east_west_m)
    across = (np.arange(shape[1])[None, :] + 0.5) / shape[1] * room.east_west_m
    rng = np.random.default_rng(_SEED)
    sheet = np.floor(across / _SHEET_M).astype(int)
    tone = 1.0 + 0.02 * rng.standard_normal(sheet.max() + 1)[sheet]
    seam = np.where(across % _SHEET_M < 0.008, 0.82, 1.0)
    grains: tuple[tuple[float, tuple[float, float]], ...] = (
        (0.045, (2, 2)),
        (0.03, (5, 14)),
        (0.015, (90, 90)),
    )
    marble = 1.0 + sum(much * _sheet(rng, shape, grain_px) for much, grain_px in grains)
    plain = coloured(_LINO, tone * seam * marble)
    shade = cv2.resize(floor_light(room), (shape[1], shape[0]), interpolation=cv2.INTER_LINEAR)
    return as_picture(plain * np.asarray(shade, dtype=np.float64)[..., None])


def floor_light(room: Room) -> NDArray[np.float64]:
    """Return the light that reaches the floor, 0 to 1, (rows, columns), first row in the north.

    Walls and things on the floor cast a short shadow. Things above the floor, such as tables, cast
    a soft shadow under and around them.
    """
    x_min, y_min, x_max, y_max = room.bounds
    scale = _SHADE_PIXELS_PER_M
    shape = round((y_max - y_min) * scale), round((x_max - x_min) * scale)
    on_floor = np.zeros(shape, np.uint8)
    above = np.zeros(shape, np.uint8)
    parts = [(solid.shape, solid.low_m) for piece in room.furniture for solid in piece.solids]
    for outline, low_m in parts:
        ring = (shapely.get_coordinates(shapely.get_exterior_ring(outline)) - (x_min, y_max)) * (
            scale,
            -scale,
        )
        # Coordinates of pixel centres, in sixteenths.
        corners = np.round((ring - 0.5) * 16).astype(np.int32)
        cv2.fillPoly(above, [corners], 1, cv2.LINE_8, 4)
        if low_m == 0.0:
            cv2.fillPoly(on_floor, [corners], 1, cv2.LINE_8, 4)
    walled = cv2.copyMakeBorder(1 - on_floor, 1, 1, 1, 1, cv2.BORDER_CONSTANT, value=0)
    away_m = cv2.distanceTransform(walled, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)[1:-1, 1:-1] / scale
    depth, reach_m = _AROUND
    soft = cv2.GaussianBlur(
        above.astype(np.float64), (0, 0), reach_m * scale, borderType=cv2.BORDER_REFLECT
    )
    return (1.0 - _CONTACT[0] * np.exp(-away_m / _CONTACT[1])) * (1.0 - depth * soft)


def paint_wall(colour: Rgb, length_m: float, height_m: float, seed: int) -> NDArray[np.uint8]:
    """Paint a wall with its skirting, slightly uneven, darker in corners and near the floor."""
    shape = min(_pixels(height_m) // 4, 512), min(_pixels(length_m) // 4, 1024)
    rng = np.random.default_rng([_SEED, seed])
    up = (np.arange(shape[0])[::-1, None] + 0.5) / shape[0] * height_m
    along = (np.arange(shape[1])[None, :] + 0.5) / shape[1] * length_m
    corner = np.minimum(along, length_m - along)
    light = (
        (1 - 0.16 * np.exp(-up / 0.25))
        * (1 - 0.13 * np.exp(-corner / 0.3))
        * (1 - 0.08 * np.exp(-(height_m - up)))
    )
    picture = coloured(colour, light * (1.0 + 0.012 * layered(rng, shape, (2.0, 70.0))))
    board = round(_SKIRTING_M / height_m * shape[0])
    picture[-board:] = (214, 211, 202)
    picture[-board - 1] = (150, 147, 140)
    return picture


def paint_ceiling() -> NDArray[np.uint8]:
    """Paint four by four mineral tiles with a row of two lamps, seamless."""
    rng = np.random.default_rng(_SEED)
    size = 512
    tile = 128
    picture = coloured((196, 196, 192), 1.0 + 0.05 * noise(rng, (size, size), 1.2))
    for line in range(0, size, tile):
        picture[line : line + 3] = 164
        picture[:, line : line + 3] = 164
    picture[tile + 6 : 2 * tile - 4, tile + 6 : 3 * tile - 4] = (252, 251, 246)
    picture[tile + 6 : 2 * tile - 4, 2 * tile - 2 : 2 * tile + 4] = 190
    return picture


def _pixels(metres: float) -> int:
    """Return the power of two of pixels that covers a length."""
    return int(min(2 ** np.ceil(np.log2(metres * _PIXELS_PER_M)), _LARGEST_PX))


def _sheet(
    rng: np.random.Generator, shape: tuple[int, ...], grain_px: tuple[float, float]
) -> NDArray[np.float64]:
    """Return noise of a shape, repeated after 1024 pixels, since noise is slow."""
    rows, columns = (min(count, 1024) for count in shape)
    return np.tile(noise(rng, (rows, columns), grain_px), (shape[0] // rows, shape[1] // columns))

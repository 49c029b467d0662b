"""Furniture as meshes, with what they wear; each piece fills the footprint and the height that it states."""

import math
import zlib
from collections.abc import Callable, Iterable
from itertools import pairwise, product
from typing import Final

import numpy as np
import shapely
from numpy.typing import NDArray

from services.simulator.scene.meshes import TEXTURE_M, Mesh, block, cased, flat, front, quads, tube
from services.simulator.scene.surfaces import Finish, Piece
from services.simulator.world import furniture as sizes
from services.simulator.world.furniture import Box, Furniture, FurnitureKind
from services.simulator.world.place import Pose

_CRATE_M: Final = 0.36
_CRATE_TURN_RAD: Final = 0.09
_BAY_M: Final = 1.0
_COMPARTMENT_M: Final = 0.36
_SHELF_BOARD_M: Final = 0.022
_VARIANTS: Final = 4


def furnish(piece: Furniture) -> list[Piece]:
    """Return a piece of furniture where it stands."""
    pose = Pose(piece.x_m, piece.y_m, piece.heading)
    return [(finish, mesh.placed(pose)) for finish, mesh in _MAKERS[piece.kind](piece)]


def _variant(piece: Furniture) -> int:
    """Return which of a few looks a piece has, by its size and colour, so that equal pieces look the same."""
    size = (piece.kind, piece.width_m, piece.depth_m, piece.height_m, piece.colour)
    return zlib.crc32(repr(size).encode()) % _VARIANTS


def _blocks(finish: Finish, boxes: Iterable[tuple[Box, float, float]]) -> list[Piece]:
    return [(finish, block(box, low, high)) for box, low, high in boxes]


def _crate(piece: Furniture) -> list[Piece]:
    count = max(1, round(piece.height_m / _CRATE_M))
    side, top = Finish("carton", piece.colour, _variant(piece)), Finish("cardboard", piece.colour)
    step = piece.height_m / count
    made: list[Piece] = []
    for level in range(count):
        turn, shrink = (Pose(0.0, 0.0, 0.0), 1.0) if level % 2 == 0 else _turned_within(piece)
        x, y = shrink * piece.depth_m / 2, shrink * piece.width_m / 2
        low, high = level * step, (level + 1) * step
        tape = shapely.box(-x, -0.05 * piece.width_m, x, 0.05 * piece.width_m)
        parts = [
            (side, cased((-x, -y, x, y), low, high)),
            (top, flat(shapely.box(-x, -y, x, y), high, TEXTURE_M)),
            (Finish("lacquer", (206, 178, 128)), flat(tape, high + 0.001, 1.0)),
        ]
        made += [(finish, mesh.placed(turn)) for finish, mesh in parts]
    return made


def _turned_within(piece: Furniture) -> tuple[Pose, float]:
    """Return how an upper box is turned, and how much smaller it is so that it stays within the footprint."""
    cos, sin = math.cos(_CRATE_TURN_RAD), math.sin(_CRATE_TURN_RAD)
    x, y = piece.depth_m, piece.width_m
    return Pose(0.0, 0.0, _CRATE_TURN_RAD), min(0.84, x / (x * cos + y * sin), y / (y * cos + x * sin))


def _cabinet(piece: Furniture) -> list[Piece]:
    x_min, y_min, x_max, y_max = piece.box
    body = (x_min, y_min, x_max - 0.01, y_max)
    return [
        (Finish("black_plastic"), block((x_min + 0.02, y_min + 0.02, x_max - 0.03, y_max - 0.02), 0.0, 0.05)),
        (Finish("lacquer", piece.colour), block(body, 0.05, piece.height_m)),
        (Finish("drawers", piece.colour, 0), front(body, 0.06, piece.height_m - 0.01, 0.01)),
    ]


def _shelf(piece: Furniture) -> list[Piece]:
    x_min, y_min, x_max, y_max = box = piece.box
    rows = max(1, round(piece.height_m / _COMPARTMENT_M))
    bays = max(1, round(piece.width_m / _BAY_M))
    uprights = np.linspace(y_min, y_max - _SHELF_BOARD_M, bays + 1).tolist()
    heights = np.linspace(0.04, piece.height_m - _SHELF_BOARD_M, rows + 1).tolist()
    boards = [((x_min, y_min, x_min + 0.012, y_max), 0.0, piece.height_m)]
    boards += [((x_min, y, x_max, y + _SHELF_BOARD_M), 0.0, piece.height_m) for y in uprights]
    boards += [(box, z, z + _SHELF_BOARD_M) for z in heights]
    made = _blocks(Finish("wood", piece.colour), boards)
    for row, (low, high) in enumerate(pairwise(heights)):
        for bay, (left, right) in enumerate(pairwise(uprights)):
            books = front((x_min, left + _SHELF_BOARD_M, x_max - 0.05, right), low + _SHELF_BOARD_M, high)
            made.append((Finish("books", None, (_variant(piece) + 3 * row + bay) % 7), books))
    return made


def _partition(piece: Furniture) -> list[Piece]:
    x_min, y_min, x_max, y_max = piece.box
    joints = np.linspace(y_min, y_max, max(1, round(piece.width_m / _BAY_M)) + 1).tolist()
    thin, high = 0.3 * piece.depth_m, piece.height_m
    frame = thin + 0.004
    made: list[Piece] = []
    for left, right in pairwise(joints):
        made.append(
            (Finish("fabric", piece.colour), block((-thin, left + 0.025, thin, right - 0.025), 0.06, high - 0.025))
        )
        rails = [((-frame, left, frame, right), low, top) for low, top in ((high - 0.025, high), (0.03, 0.06))]
        posts = [((-frame, edge, frame, edge + 0.025), 0.0, high - 0.01) for edge in (left, right - 0.025)]
        made += _blocks(Finish("aluminium"), [*rails, *posts])
        made.append((Finish("dark_plastic"), block((x_min, left + 0.1, x_max, right - 0.1), 0.0, 0.03)))
    return made


def _desk(piece: Furniture) -> list[Piece]:
    x_min, _, _, y_max = box = piece.box
    top = piece.height_m
    under = top - sizes.BOARD_M
    screen = (x_min + 0.14, -0.28, x_min + 0.17, 0.28)
    stand = [
        ((x_min + 0.08, -0.12, x_min + 0.26, 0.12), top, top + 0.015),
        ((x_min + 0.13, -0.03, x_min + 0.15, 0.03), top, top + 0.14),
        (screen, top + 0.12, top + 0.46),
    ]
    return [
        (Finish("board", piece.colour), block(box, under, top)),
        *_blocks(Finish("lacquer", (214, 214, 210)), [(part, 0.0, under) for part in piece.panels]),
        (Finish("drawers", (214, 214, 210), 1), front(piece.panels[0], 0.03, under - 0.02, 0.002)),
        *_blocks(Finish("black_plastic"), stand),
        (Finish("screen", None, 2), front(screen, top + 0.13, top + 0.45, 0.002)),
        (Finish("dark_plastic"), block((0.02, -0.22, 0.16, 0.22), top, top + 0.02)),
        (Finish("white_plastic"), block((x_min + 0.1, y_max - 0.36, x_min + 0.32, y_max - 0.2), top, top + 0.03)),
    ]


def _table(piece: Furniture) -> list[Piece]:
    x_min, y_min, x_max, y_max = box = piece.box
    under = piece.height_m - sizes.BOARD_M
    rails = [(x_min + 0.02, y, x_max - 0.02, y + 0.025) for y in (y_min + 0.02, y_max - 0.045)]
    rails += [(x, y_min + 0.02, x + 0.025, y_max - 0.02) for x in (x_min + 0.02, x_max - 0.045)]
    steel = [*((leg, 0.0, under) for leg in piece.legs), *((rail, under - 0.05, under) for rail in rails)]
    return [(Finish("board", piece.colour), block(box, under, piece.height_m)), *_blocks(Finish("dark_plastic"), steel)]


def _chair(piece: Furniture) -> list[Piece]:
    x_min, y_min, _, y_max = box = piece.box
    seat, cloth = sizes.CHAIR_FRACTION * piece.height_m, Finish("fabric", piece.colour)
    back = x_min, y_min, x_min + sizes.CHAIR_BACK_M, y_max
    cushions = [(box, seat - sizes.BOARD_M, seat), (back, seat, piece.height_m)]
    return _blocks(Finish("aluminium"), [(leg, 0.0, seat) for leg in piece.legs]) + _blocks(cloth, cushions)


def _car(piece: Furniture) -> list[Piece]:
    paint, bonnet, (behind, right, ahead, left) = (
        Finish("lacquer", piece.colour or (70, 92, 120)), sizes.BONNET_FRACTION * piece.height_m, piece.cabin
    )  # fmt: skip
    wheel, half = 0.22 * piece.height_m, piece.width_m / 2 - 0.02
    made: list[Piece] = [
        (paint, block(piece.box, sizes.SILLS_M, bonnet)),
        (Finish("dark_plastic"), block(piece.cabin, bonnet, piece.height_m - 0.06)),
        (paint, block((behind + 0.05, right, ahead - 0.3, left), piece.height_m - 0.06, piece.height_m)),
    ]
    for x, side in product((-0.3 * piece.depth_m, 0.3 * piece.depth_m), (1.0, -1.0)):
        # A tube, and the disc at its outer end.
        for inner, outer, radius in ((half - 0.2, half, wheel), (half, half + 1e-3, 1e-3)):
            tyre = tube((x, side * inner, wheel), (x, side * outer, wheel), (wheel, radius), 16)
            made.append((Finish("tyre"), tyre))
    return made


def _sofa(piece: Furniture) -> list[Piece]:
    x_min, y_min, x_max, y_max = piece.box
    colour = piece.colour or (156, 79, 67)
    cloth = Finish("fabric", colour)
    red, green, blue = (min(255, round(1.12 * value + 8)) for value in colour)
    seat, arms, top = sizes.SEAT_FRACTION * piece.height_m, sizes.ARM_FRACTION * piece.height_m, piece.height_m
    back, roll, side = x_min + sizes.SOFA_BACK_M, 0.05, sizes.SOFA_ARM_M / 2
    middle = (x_min + back) / 2 - 0.02
    made: list[Piece] = [
        (Finish("black_plastic"), block((x_min + 0.03, y_min + 0.03, x_max - 0.04, y_max - 0.03), 0.0, 0.06)),
        (cloth, block((x_min, y_min, x_max, y_max), 0.06, seat - 0.12)),
        (cloth, block((x_min, y_min, back - 0.04, y_max), seat - 0.12, top - roll)),
        (cloth, tube((middle, y_min, top - roll), (middle, y_max, top - roll), (roll, roll), 12)),
    ]
    for y in (y_min, y_max - sizes.SOFA_ARM_M):
        made.append((cloth, block((x_min, y, x_max, y + sizes.SOFA_ARM_M), 0.06, arms - side)))
        # A round top with flat ends.
        for begin, end, radius in ((x_min, x_max, side), (x_min, x_min - 1e-4, 1e-4), (x_max, x_max + 1e-4, 1e-4)):
            made.append((cloth, tube((begin, y + side, arms - side), (end, y + side, arms - side), (side, radius), 16)))
    seats = max(1, round((piece.width_m - 2 * sizes.SOFA_ARM_M) / 0.6))
    cushions: list[tuple[Box, float, float]] = []
    for left, right in pairwise(np.linspace(y_min + sizes.SOFA_ARM_M, y_max - sizes.SOFA_ARM_M, seats + 1).tolist()):
        cushions.append(((back - 0.04, left + 0.008, x_max - 0.01, right - 0.008), seat - 0.12, seat))
        cushions.append(((back - 0.06, left + 0.012, back + 0.09, right - 0.012), seat, top - 0.03))
    return made + _blocks(Finish("fabric", (red, green, blue)), cushions)


def _plant(piece: Furniture) -> list[Piece]:
    rng = np.random.default_rng(round(1000 * piece.height_m))
    radius, height = piece.width_m / 2, piece.height_m
    pot = 0.3 * height
    made: list[Piece] = [
        (Finish("pot", piece.colour), tube((0, 0, 0), (0, 0, pot), (0.45 * radius, 0.62 * radius), 20)),
        (Finish("soil"), flat(shapely.Point(0, 0).buffer(0.6 * radius), 0.92 * pot, 0.3)),
    ]
    made += [(Finish("foliage"), leaf) for tip in _tips(piece, rng) for leaf in _leaf(tip, pot, rng)]
    return made


def _tips(piece: Furniture, rng: np.random.Generator) -> NDArray[np.float64]:
    """Return where leaves end (26, 3): a spiral that narrows upwards, as wide and as high as the plant."""
    up = np.arange(26) / 25
    turn = 2.4 * np.arange(26)
    out = (0.92 - 0.5 * up**2) * rng.uniform(0.75, 1.0, 26)
    high = (0.45 + 0.5 * up) * rng.uniform(0.92, 1.05, 26)
    out, high = 0.95 * piece.width_m / 2 * out / out.max(), piece.height_m * high / high.max()
    return np.column_stack([out * np.cos(turn), out * np.sin(turn), high])


def _leaf(tip: NDArray[np.float64], pot: float, rng: np.random.Generator) -> list[Mesh]:
    steps = np.linspace(0, 1, 6)[:, None]
    root = np.array([0.0, 0.0, 0.9 * pot])
    knee = np.array([0.35 * tip[0], 0.35 * tip[1], 0.85 * tip[2] + 0.15 * pot])
    spine = (1 - steps) ** 2 * root + 2 * steps * (1 - steps) * knee + steps**2 * tip
    across = np.array([-tip[1], tip[0], 0.0]) / max(float(np.hypot(tip[0], tip[1])), 1e-6)
    # Broad in its middle, and never past the tip, so that the plant stays within its circle.
    half = (0.012 + 0.04 * np.sin(np.pi * steps) ** 1.2) * rng.uniform(0.8, 1.1)
    half[-1] = 0.002
    left, right = spine - across * half, spine + across * half
    corners = np.stack([left[:-1], right[:-1], right[1:], left[1:]], axis=1)
    uvs = np.broadcast_to([(0.0, 0.2), (0.2, 0.2), (0.2, 0.0), (0.0, 0.0)], (len(corners), 4, 2))
    sheet = quads(corners, uvs)
    return [sheet, sheet.flipped()]


_MAKERS: Final[dict[FurnitureKind, Callable[[Furniture], list[Piece]]]] = {
    "cabinet": _cabinet, "car": _car, "chair": _chair, "crate": _crate, "desk": _desk, "partition": _partition,
    "plant": _plant, "shelf": _shelf, "sofa": _sofa, "table": _table,
}  # fmt: skip

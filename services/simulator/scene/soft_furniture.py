"""What is not made of boards: sofas, chairs, plants."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import shapely

from services.simulator.scene.boxes import block, box_of
from services.simulator.scene.finishes import Finish, Piece
from services.simulator.scene.meshes import Mesh, quads
from services.simulator.scene.shapes import ball, flat, tube
from services.simulator.world.furniture import ARM_FRACTION, SEAT_FRACTION, SOFA_ARM_M, SOFA_BACK_M, Furniture

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from services.simulator.world.place import Rgb


def sofa(piece: Furniture) -> list[Piece]:
    """Return a sofa: plinth, back, arms with round tops, and a cushion a seat."""
    x_min, y_min, x_max, y_max = box_of(piece)
    cloth = Finish("fabric", piece.colour or (156, 79, 67))
    light = Finish("fabric", _lighter(piece.colour or (156, 79, 67)))
    seat, arms, top = SEAT_FRACTION * piece.height_m, ARM_FRACTION * piece.height_m, piece.height_m
    back = x_min + SOFA_BACK_M
    roll = 0.05
    made: list[Piece] = [
        (Finish("black_plastic"), block((x_min + 0.03, y_min + 0.03, x_max - 0.04, y_max - 0.03), 0.0, 0.06)),
        (cloth, block((x_min, y_min, x_max, y_max), 0.06, seat - 0.12)),
        (cloth, block((x_min, y_min, back - 0.04, y_max), seat - 0.12, top - roll)),
        (
            cloth,
            tube(
                ((x_min + back) / 2 - 0.02, y_min, top - roll),
                ((x_min + back) / 2 - 0.02, y_max, top - roll),
                (roll, roll),
                12,
            ),
        ),
    ]
    for side in (y_min, y_max - SOFA_ARM_M):
        made.append((cloth, block((x_min, side, x_max, side + SOFA_ARM_M), 0.06, arms - SOFA_ARM_M / 2)))
        middle = side + SOFA_ARM_M / 2
        made += [(cloth, part) for part in _roll((x_min, middle, arms - SOFA_ARM_M / 2), x_max, SOFA_ARM_M / 2)]
    seats = max(1, round((piece.width_m - 2 * SOFA_ARM_M) / 0.6))
    edges = np.linspace(y_min + SOFA_ARM_M, y_max - SOFA_ARM_M, seats + 1)
    for left, right in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True):
        made.append((light, block((back - 0.04, left + 0.008, x_max - 0.01, right - 0.008), seat - 0.12, seat)))
        made.append((light, block((back - 0.06, left + 0.012, back + 0.09, right - 0.012), seat, top - 0.03)))
    return made


def _roll(start: tuple[float, float, float], x_end: float, radius: float) -> list[Mesh]:
    """Return a round top along x with flat ends."""
    _, y, z = start
    ends = [tube((x, y, z), (x + ahead, y, z), (radius, 1e-4), 16) for x, ahead in ((start[0], -1e-4), (x_end, 1e-4))]
    return [tube(start, (x_end, y, z), (radius, radius), 16), *ends]


def chair(piece: Furniture) -> list[Piece]:
    """Return a swivel chair: five feet with castors, a gas spring, a round-edged seat and a back."""
    radius, height = piece.width_m / 2, piece.height_m
    cloth, black = Finish("fabric", piece.colour or (62, 68, 78)), Finish("black_plastic")
    seat = 0.52 * height
    made: list[Piece] = [(black, tube((0, 0, 0.07), (0, 0, seat - 0.05), (0.028, 0.028), 10))]
    for foot in range(5):
        turn = 2 * np.pi * foot / 5 + 0.3
        end = (0.88 * radius * np.cos(turn), 0.88 * radius * np.sin(turn))
        made.append((black, tube((0, 0, 0.11), (*end, 0.075), (0.026, 0.016), 8)))
        made.append((Finish("dark_plastic"), ball((*end, 0.03), (0.025, 0.025, 0.03), 6)))
    wide = 0.78 * radius
    made.append((cloth, ball((0.03, 0.0, seat - 0.01), (wide, wide, 0.055), 10)))
    made.append((black, tube((-0.75 * wide, 0, seat), (-0.92 * wide, 0, 0.78 * height), (0.02, 0.016), 8)))
    made.append((cloth, ball((-0.9 * wide, 0.0, 0.79 * height), (0.045, 0.8 * wide, 0.2 * height), 10)))
    return made


def plant(piece: Furniture) -> list[Piece]:
    """Return a potted plant: long leaves about a few stems, fuller above."""
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
    """Return a leaf that bends from the pot's middle to its tip, drawn from both sides."""
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


def _lighter(colour: Rgb) -> Rgb:
    red, green, blue = (min(255, round(1.12 * value + 8)) for value in colour)
    return red, green, blue

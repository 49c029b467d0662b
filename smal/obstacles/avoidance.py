"""Way around obstacles: the turn after which driving straight on leads back to the taught way.

The taught way ahead is projected into the occupancy grid around the robot (`Surroundings`). If the
way is free, nothing changes. Otherwise every cell has a cost to go: the way to the point where the
taught way leaves the grid. The cost is higher near obstacles, beside the taught way and over
unknown ground. Cells too far aside for the filter are closed. The robot then turns so that driving
straight on leads to the least cost to go, without a collision (after the global dynamic window,
Brock and Khatib 1999).
"""

import math
from functools import lru_cache
from typing import Final, NamedTuple

import numpy as np
from scipy import sparse
from scipy.ndimage import distance_transform_edt
from scipy.sparse.csgraph import dijkstra

from smal.arrays import Bools, Floats, Indices
from smal.movement import wrapped
from smal.obstacles.clearance import Surroundings
from smal.obstacles.occupancy import GRID_CONFIG

#: Extra cost of a metre without clearance, a correlation length beside the way, or over unknown
#: ground.
_DEAR: Final = 1.5
#: Maximum number of candidate turns to each side: a degree apart.
_TURNS: Final = 180


class Turns(NamedTuple):
    """Scales of a way around obstacles."""

    #: Turns are multiples of this angle.
    turn_rad: float
    #: Way that takes as long as such a turn.
    step_m: float
    #: Distance beside the taught way over which views change.
    known_m: float


def detour_turn(
    around: Surroundings, way: Floats, turns: Turns, error_rad: float, evades: bool
) -> float | None:
    """Return the turn to the left that leads around obstacles on a taught way; None to stop.

    Parameters
    ----------
    around : Surroundings
    way : array (s, 2)
        Places ahead and left of the robot.
    turns : Turns
    error_rad : float
        Turn to the way. The result if the way is free, or is blocked only far ahead.
    evades : bool
        Whether the robot is already on a way around obstacles.
    """
    # The taught drive has passed here: only an obstacle in the robot's path blocks the way.
    far_m = hit_m(around, way, around.body_m if evades else around.radius_m)
    aligned = abs(error_rad) < turns.turn_rad
    if far_m == math.inf and not (aligned and around.free_m(ahead=True) == 0.0):
        return error_rad
    round_rad = best_turn(around, way, turns)
    # Nearer, an obstacle without a way around hides the taught views.
    near = far_m < around.reach_m / 2.0
    return round_rad if round_rad is not None or near else error_rad


def hit_m(around: Surroundings, way: Floats, margin_m: float) -> float:
    """Return the free distance along places (s, 2); infinite without an obstacle in the margin."""
    clear_m = around.clearance_m[around.cells(_dense(way, around))]
    hits = np.flatnonzero(clear_m < margin_m)
    return float(hits[0] * around.cell_m / 2.0) if hits.size else math.inf


def best_turn(around: Surroundings, way: Floats, turns: Turns) -> float | None:
    """Return the turn to the left that leads around obstacles to a way (s, 2); None without any."""
    count = min(round(math.pi / turns.turn_rad), _TURNS)
    # The smaller of two equal turns comes first.
    steps = np.array(sorted(range(-count, count + 1), key=abs))
    turns_rad = steps * turns.turn_rad
    straight_m = np.arange(1, math.floor(around.reach_m / around.cell_m)) * around.cell_m
    towards = np.stack([np.cos(turns_rad), np.sin(turns_rad)], axis=1)
    cells = around.cells(straight_m[:, None] * towards[:, None])
    leads = straight_m <= around.clear_m(turns_rad)[:, None]
    to_go_m, following = _to_go_m(around, way, turns.known_m)
    back = _turns_back(around, cells, following, turns_rad) / turns.turn_rad
    straight_on_m = np.where(leads, to_go_m[cells] + straight_m, np.inf)
    left_m = straight_on_m + turns.step_m * (np.abs(steps)[:, None] + back)
    best = np.unravel_index(left_m.argmin(), left_m.shape)
    return float(turns_rad[best[0]]) if np.isfinite(left_m[best]) else None


def _turns_back(
    around: Surroundings, cells: tuple[Indices, Indices], following: Indices, turns_rad: Floats
) -> Floats:
    """Return the later turn in each cell, beyond 45 degrees, radians.

    A robot that must turn back there can as well turn now. Without this cost it postpones the turn
    for ever.
    """
    side = len(around.clearance_m)
    start = np.ravel_multi_index(cells, around.clearance_m.shape)
    onwards = start
    for _ in range(2 * GRID_CONFIG.cells_radius):
        onwards = following[onwards]
    x, y = np.divmod(start, side)
    to_x, to_y = np.divmod(onwards, side)
    off_rad = wrapped(np.arctan2(to_y - y, to_x - x) - around.heading - turns_rad[:, None])
    beyond_rad = np.maximum(np.abs(off_rad) - math.pi / 4.0, 0.0)
    return np.where(start == onwards, 0.0, beyond_rad)


def _to_go_m(around: Surroundings, way: Floats, known_m: float) -> tuple[Floats, Indices]:
    """Return the cost to go from each cell to the end of the way, metres, and the next cell.

    Cells are numbered row by row. Without a way the cost is infinite, and the cell is its own
    successor.
    """
    dense = _until_blocked(_dense(way, around), around)
    track = np.full(around.clearance_m.shape, -1, dtype=np.intp)
    track[around.cells(dense)] = np.arange(len(dense))
    aside, (row, column) = distance_transform_edt(track < 0, return_indices=True)
    aside_m = aside * around.cell_m
    may = _open_cells(around, aside_m)
    ends = np.flatnonzero(may & (track[row, column] >= len(dense) - 3))
    number = np.arange(may.size)
    if not ends.size:
        return np.full(may.shape, np.inf), number
    one, other, apart_m = _edges(len(may), around.cell_m)
    cost = np.where(may, _cost(around, aside_m / known_m), np.inf).ravel()
    costs_m = (cost[one] + cost[other]) / 2.0 * apart_m
    used = np.isfinite(costs_m)
    edges = (costs_m[used], (one[used], other[used]))
    graph = sparse.csr_array(edges, shape=(may.size, may.size))
    to_go_m, following, _ = dijkstra(
        graph, directed=False, indices=ends, min_only=True, return_predecessors=True
    )
    return np.asarray(to_go_m).reshape(may.shape), np.where(following < 0, number, following)


def _until_blocked(dense: Floats, around: Surroundings) -> Floats:
    """Cut a way (s, 2) at the edge of the grid, and after its last free place."""
    outside = np.hypot(*dense.T) > around.reach_m - 2.0 * around.cell_m
    if outside.any():
        dense = dense[: max(1, int(outside.argmax()))]
    free = np.flatnonzero(around.clearance_m[around.cells(dense)] >= around.body_m)
    return dense[: 1 + free.max(initial=0)]


def _open_cells(around: Surroundings, aside_m: Floats) -> Bools:
    """Return the cells in which the robot can stand, and the cells by which it can leave."""
    clear_m = around.clearance_m
    robot = around.cells(np.zeros(2))
    leaves = (around.away_m < 1.5 * around.radius_m) & (clear_m >= clear_m[robot] - 1e-3)
    most_aside_m = max(around.reach_m / 2.0, float(aside_m[robot]))
    return ((clear_m >= around.body_m) | leaves) & (aside_m <= most_aside_m)


def _cost(around: Surroundings, aside: Floats) -> Floats:
    """Return the cost of a metre in each cell; more clearance than the robot's width is no use."""
    room_m = 2.0 * around.radius_m
    tight = (room_m - around.clearance_m) / (room_m - around.body_m)
    return np.asarray(1.0 + _DEAR * (tight.clip(0.0, 1.0) + aside + around.unknown))


def _dense(way: Floats, around: Surroundings) -> Floats:
    """Return a way (s, 2) from the robot on, with places at most half a cell apart.

    A place far outside of the grid is moved nearer, in its direction: a belief can be a thousand
    kilometres off.
    """
    apart_m = around.cell_m / 2.0
    most_m = 2.0 * around.reach_m
    nearer = most_m / np.maximum(np.hypot(*way.T), most_m)
    corners = np.concatenate([np.zeros((1, 2)), way * nearer[:, None]])
    along = np.append(0.0, np.cumsum(np.hypot(*np.diff(corners, axis=0).T)))
    places = np.arange(0.0, along[-1] + apart_m, apart_m)
    return np.stack([np.interp(places, along, column) for column in corners.T], axis=1)


@lru_cache(maxsize=2)
def _edges(side: int, cell_m: float) -> tuple[Indices, Indices, Floats]:
    """Return the pairs of neighbours among cells, counted row by row, and their distance."""
    number = np.arange(side * side).reshape(side, side)
    pairs = [
        (number[:-1], number[1:], 1.0),
        (number[:, :-1], number[:, 1:], 1.0),
        (number[:-1, :-1], number[1:, 1:], math.sqrt(2.0)),
        (number[:-1, 1:], number[1:, :-1], math.sqrt(2.0)),
    ]
    one = np.concatenate([a.ravel() for a, _, _ in pairs])
    other = np.concatenate([b.ravel() for _, b, _ in pairs])
    apart = np.concatenate([np.full(a.size, cells) for a, _, cells in pairs])
    return one, other, apart * cell_m

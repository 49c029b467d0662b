"""Way around obstacles: the turn after which driving straight on leads back to the taught way soonest.

The taught way ahead is projected into the occupancy grid around the robot (`Surroundings`). If the way is free, nothing
changes. Otherwise every cell has a cost to go: the way to the point where the taught way leaves the grid. The cost is
higher near obstacles and beside the taught way. Cells too far aside for the filter are closed. The robot then turns so
that driving straight on leads to the least cost to go, without a collision (after the global dynamic window, Brock and
Khatib 1999).
"""

import math
from functools import lru_cache

import numpy as np
from scipy import sparse
from scipy.ndimage import distance_transform_edt
from scipy.sparse.csgraph import dijkstra

from smal.arrays import Bools, Floats, Indices
from smal.movement import wrapped
from smal.obstacles.clearance import Surroundings


def way_round(
    around: Surroundings,
    way: Floats,
    turn_rad: float,
    step_m: float,
    known_m: float,
    error_rad: float,
) -> float | None:
    """Return the turn to the left that leads around obstacles on a way (s, 2); None to stop.

    The turn is `error_rad` if the way is free, or blocked only far ahead. For the other parameters see `turn_round`.
    """
    far_m = hit_m(around, way)
    blocked = far_m < math.inf or around.free_m(ahead=True) == 0.0
    if not blocked:
        return error_rad
    round_rad = turn_round(around, way, turn_rad, step_m, known_m)
    near = far_m < around.reach_m / 2.0
    return round_rad if round_rad is not None or near else error_rad


def hit_m(around: Surroundings, way: Floats) -> float:
    """Return the free distance along places (s, 2), ahead and left of the robot; infinite without an obstacle."""
    clear_m = around.clearance_m[around.cells(_dense(way, around))]
    hits = np.flatnonzero(clear_m < around.body_m)
    return float(hits[0] * around.cell_m / 2.0) if hits.size else math.inf


def turn_round(
    around: Surroundings, way: Floats, turn_rad: float, step_m: float, known_m: float
) -> float | None:
    """Return the turn to the left that leads around obstacles to a way (s, 2); None if there is no such turn.

    Parameters
    ----------
    around : Surroundings
    way : array (s, 2)
        Places ahead and left of the robot.
    turn_rad : float
        Turns are multiples of this angle.
    step_m : float
        Way that takes as long as one such turn.
    known_m : float
        Distance beside the way over which views change: a metre costs more the further aside it is.
    """
    count = min(round(math.pi / turn_rad), 180)
    turns = np.array(sorted(range(-count, count + 1), key=abs))
    turns_rad = turns * turn_rad
    straight_m = np.arange(1, math.floor(around.reach_m / around.cell_m)) * around.cell_m
    towards = np.stack([np.cos(turns_rad), np.sin(turns_rad)], axis=1)
    cells = around.cells(straight_m[:, None] * towards[:, None])
    leads = straight_m <= around.clear_m(turns_rad)[:, None]
    to_go_m, following = _to_go_m(around, way, known_m)
    back = _turns_back(around, cells, following, turns_rad) / turn_rad
    straight_on_m = np.where(leads, to_go_m[cells] + straight_m, np.inf)
    left_m = straight_on_m + step_m * (np.abs(turns)[:, None] + back)
    best = np.unravel_index(left_m.argmin(), left_m.shape)
    return float(turns[best[0]] * turn_rad) if np.isfinite(left_m[best]) else None


def _turns_back(
    around: Surroundings,
    cells: tuple[Indices, Indices],
    following: Indices,
    turns_rad: Floats,
) -> Floats:
    """Return the later turn in each cell, beyond 45 degrees, radians.

    A robot that must turn back there can as well turn now. Without this cost it postpones the turn for ever.
    """
    side = len(around.clearance_m)
    start = np.ravel_multi_index(cells, around.clearance_m.shape)
    onwards = start
    for _ in range(2 * around.config.cells_radius):
        onwards = following[onwards]
    x, y = np.divmod(start, side)
    to_x, to_y = np.divmod(onwards, side)
    direction_rad = np.arctan2(to_y - y, to_x - x)
    off_rad = wrapped(direction_rad - around.heading - turns_rad[:, None])
    beyond_rad = np.maximum(np.abs(off_rad) - math.pi / 4.0, 0.0)
    return np.where(start == onwards, 0.0, beyond_rad)


def _to_go_m(around: Surroundings, way: Floats, known_m: float) -> tuple[Floats, Indices]:
    """Return the cost to go from every cell to the end of the way in the grid, metres, and the next cell.

    Cells are numbered row by row. Without a way the cost is infinite, and the cell is its own successor.
    """
    dense = _until_blocked(_dense(way, around), around)
    clear_m = around.clearance_m
    track = np.full(clear_m.shape, -1, dtype=np.intp)
    track[around.cells(dense)] = np.arange(len(dense))
    aside, (row, column) = distance_transform_edt(track < 0, return_indices=True)
    aside_m = aside * around.cell_m
    along = track[row, column]
    may = _open_cells(around, aside_m)
    ends = np.flatnonzero(may & (along >= len(dense) - 3))
    if not ends.size:
        return np.full(may.shape, np.inf), np.arange(may.size)
    cost = _cost(around, aside_m, known_m)
    one, other, apart = _edges(len(may))
    cost_m = np.where(may, cost, np.inf).ravel() * around.cell_m
    costs = (cost_m[one] + cost_m[other]) / 2.0 * apart
    used = np.isfinite(costs)
    graph = sparse.csr_array((costs[used], (one[used], other[used])), shape=(may.size, may.size))
    to_go_m, following, _ = dijkstra(
        graph, directed=False, indices=ends, min_only=True, return_predecessors=True
    )
    following = np.where(following < 0, np.arange(may.size), following)
    return np.asarray(to_go_m).reshape(may.shape), np.asarray(following, dtype=np.intp)


def _until_blocked(dense: Floats, around: Surroundings) -> Floats:
    """Cut a way (s, 2) at the edge of the grid, and at the last free place: its end can be blocked."""
    outside = np.hypot(*dense.T) > around.reach_m - 2.0 * around.cell_m
    if outside.any():
        dense = dense[: max(1, int(outside.argmax()))]
    free = np.flatnonzero(around.clearance_m[around.cells(dense)] >= around.body_m)
    return dense[: 1 + free.max(initial=0)]


def _open_cells(around: Surroundings, aside_m: Floats) -> Bools:
    """Return the cells in which the robot can stand. A robot too near to an obstacle, or too far aside, can leave."""
    clear_m = around.clearance_m
    robot = around.cells(np.zeros(2))
    near = np.hypot(*around.seen_from(0.0)) < 1.5 * around.radius_m
    leaves = near & (clear_m >= clear_m[robot] - 1e-3)
    most_aside_m = max(around.reach_m / 2.0, float(aside_m[robot]))
    return ((clear_m >= around.body_m) | leaves) & (aside_m <= most_aside_m)


def _cost(around: Surroundings, aside_m: Floats, known_m: float) -> Floats:
    """Return the cost of a metre in each cell."""
    room_m = 2.0 * around.radius_m
    tight = (room_m - around.clearance_m) / (room_m - around.body_m)
    return np.asarray(
        1.0 + 2.0 * np.clip(tight, 0.0, 1.0) + 1.5 * aside_m / known_m + 0.5 * around.unknown
    )


def _dense(way: Floats, around: Surroundings) -> Floats:
    """Return a way (s, 2) from the robot on, with places at most half a cell apart.

    A place far outside of the grid is moved nearer, in its direction: a belief can be a thousand kilometres off.
    """
    apart_m = around.cell_m
    most_m = 2.0 * around.reach_m
    nearer = most_m / np.maximum(np.hypot(*way.T), most_m)
    corners = np.concatenate([np.zeros((1, 2)), way * nearer[:, None]])
    steps = np.hypot(*np.diff(corners, axis=0).T)
    along = np.append(0.0, np.cumsum(steps))
    places = np.arange(0.0, along[-1] + apart_m / 2.0, apart_m / 2.0)
    return np.stack([np.interp(places, along, column) for column in corners.T], axis=1)


@lru_cache(maxsize=2)
def _edges(side: int) -> tuple[Indices, Indices, Floats]:
    """Return the pairs of neighbours in a grid of cells, counted row by row, and their distance in cells."""
    number = np.pad(np.arange(side * side).reshape(side, side), 1, constant_values=-1)
    inner = number[1:-1, 1:-1].ravel()
    steps = ((1, 0), (0, 1), (1, 1), (1, -1))
    others = [number[1 + dx : side + 1 + dx, 1 + dy : side + 1 + dy].ravel() for dx, dy in steps]
    apart = np.repeat([math.hypot(*step) for step in steps], side * side)
    one = np.tile(inner, len(steps))
    other = np.concatenate(others)
    inside = other >= 0
    return one[inside], other[inside], apart[inside]

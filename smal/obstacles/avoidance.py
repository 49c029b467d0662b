"""Round what stands in the way: which turn, and then straight on, leads back to the taught way soonest.

The taught way ahead is laid into the grid of what stands about the robot (`Surroundings`). If a robot that follows it
touches nothing, nothing changes. Else every cell has a cost to go: the way to where the taught way leaves the grid,
dearer near what stands there, dearer the further it is from the taught way, and nowhere so far aside that the filter
would not know it. The robot then turns so that straight on leads, touching nothing, to where least is left to go (after
the dynamic window's global form, Brock and Khatib 1999).
"""

import math
from functools import lru_cache

import numpy as np
from scipy import sparse
from scipy.ndimage import distance_transform_edt
from scipy.sparse.csgraph import dijkstra

from smal.arrays import Floats, Indices
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
    """Return how far to turn left; None to stop, if nothing leads round what stands in the way (s, 2).

    It is `error_rad` if nothing stands there, or only far ahead. The rest is as in `turn_round`.
    """
    far_m = hit_m(around, way)
    if far_m < math.inf or around.free_m(ahead=True) == 0.0:
        round_rad = turn_round(around, way, turn_rad, step_m, known_m)
        if round_rad is not None or far_m < around.config.stands_before * around.radius_m:
            return round_rad
    return error_rad


def hit_m(around: Surroundings, way: Floats) -> float:
    """Return after how far a robot that goes along places (s, 2), ahead and left of it, touches something, or inf."""
    hits = np.flatnonzero(around.clearance_m[around.cells(_dense(way, around))] < around.body_m)
    return float(hits[0] * around.cell_m / 2.0) if hits.size else math.inf


def turn_round(
    around: Surroundings, way: Floats, turn_rad: float, step_m: float, known_m: float
) -> float | None:
    """Return by how much to turn, to the left, to get round to where a way (s, 2) leads; None where nothing does.

    Turns are so many times `turn_rad`, each of which takes as long as it takes to go `step_m`. Further aside of the way
    than `known_m` views have changed: a metre costs more the further aside it is.
    """
    count = min(round(math.pi / turn_rad), around.config.most_turns)
    turns = np.array(sorted(range(-count, count + 1), key=abs))
    straight_m = np.arange(1, math.floor(around.reach_m / around.cell_m)) * around.cell_m
    towards = np.stack([np.cos(turns * turn_rad), np.sin(turns * turn_rad)], axis=1)
    cells = around.cells(straight_m[:, None] * towards[:, None])
    leads = straight_m <= around.clear_m(turns * turn_rad)[:, None]
    to_go_m, following = _to_go_m(around, way, known_m)
    # Whoever has to turn back there may as well turn now, and would else put it off for ever.
    here = onwards = np.ravel_multi_index(cells, to_go_m.shape)
    for _ in range(2 * around.config.cells_radius):
        onwards = following[onwards]
    x, y = np.divmod(here, len(to_go_m))
    to_x, to_y = np.divmod(onwards, len(to_go_m))
    off_rad = wrapped(np.arctan2(to_y - y, to_x - x) - around.heading - turns[:, None] * turn_rad)
    back = (
        np.where(here == onwards, 0.0, np.maximum(np.abs(off_rad) - math.pi / 4.0, 0.0)) / turn_rad
    )
    left_m = np.where(leads, to_go_m[cells] + straight_m, np.inf) + step_m * (
        np.abs(turns)[:, None] + back
    )
    best = np.unravel_index(left_m.argmin(), left_m.shape)
    return float(turns[best[0]] * turn_rad) if np.isfinite(left_m[best]) else None


def _to_go_m(around: Surroundings, way: Floats, known_m: float) -> tuple[Floats, Indices]:
    """Return what is left to go from every cell to where the way leaves the grid, metres, and which cell is next.

    Cells are numbered row by row. Where nothing leads there it is infinite, and the cell itself is next.
    """
    dense = _dense(way, around)
    outside = np.hypot(*dense.T) > around.reach_m - 2.0 * around.cell_m
    dense = dense[: max(1, int(outside.argmax())) if outside.any() else len(dense)]
    # If something stands at the end of the way, it plans to the last free place before that.
    dense = dense[
        : 1
        + np.flatnonzero(around.clearance_m[around.cells(dense)] >= around.body_m).max(initial=0)
    ]
    track = np.full(around.clearance_m.shape, -1, dtype=np.intp)
    track[around.cells(dense)] = np.arange(len(dense))
    aside, (row, column) = distance_transform_edt(track < 0, return_indices=True)
    aside_m = aside * around.cell_m
    along = track[row, column]
    here = around.cells(np.zeros(2))
    clear_m = around.clearance_m
    body_m = around.body_m
    # A robot that stands too near to something, or too far aside, may leave.
    leaves = (np.hypot(*around.seen_from(0.0)) < 1.5 * around.radius_m) & (
        clear_m >= clear_m[here] - 1e-3
    )
    may = ((clear_m >= body_m) | leaves) & (
        aside_m <= max(around.config.may_go_aside * around.radius_m, float(aside_m[here]))
    )
    tight = np.clip(
        (around.config.room * around.radius_m - clear_m)
        / (around.config.room * around.radius_m - body_m),
        0.0,
        1.0,
    )
    cost = (
        1.0
        + around.config.tight_cost * tight
        + around.config.aside_cost * aside_m / known_m
        + around.config.unknown_cost * around.unknown
    )
    ends = np.flatnonzero(may & (along >= len(dense) - 3))
    if not ends.size:
        return np.full(may.shape, np.inf), np.arange(may.size)
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


def _dense(way: Floats, around: Surroundings) -> Floats:
    """Return a way (s, 2) from the robot on, with places no further apart than half a cell.

    A place far outside of the grid is moved nearer, in its direction: a belief may lie a thousand kilometres off.
    """
    apart_m = around.cell_m
    most_m = 2.0 * around.reach_m
    nearer = most_m / np.maximum(np.hypot(*way.T), most_m)
    corners = np.concatenate([np.zeros((1, 2)), way * nearer[:, None]])
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(corners, axis=0).T))])
    places = np.arange(0.0, along[-1] + apart_m / 2.0, apart_m / 2.0)
    return np.stack([np.interp(places, along, column) for column in corners.T], axis=1)


@lru_cache(maxsize=2)
def _edges(side: int) -> tuple[Indices, Indices, Floats]:
    """Return the pairs of neighbours in a grid of cells, counted row by row, and how many cells they are apart."""
    number = np.pad(np.arange(side * side).reshape(side, side), 1, constant_values=-1)
    inner = number[1:-1, 1:-1].ravel()
    steps = ((1, 0), (0, 1), (1, 1), (1, -1))
    others = [number[1 + dx : side + 1 + dx, 1 + dy : side + 1 + dy].ravel() for dx, dy in steps]
    apart = np.repeat([math.hypot(*step) for step in steps], side * side)
    one = np.tile(inner, len(steps))
    other = np.concatenate(others)
    return one[other >= 0], other[other >= 0], apart[other >= 0]

"""Round what stands in the way: which turn, and then straight on, leads back to the taught way soonest.

The taught way ahead is laid into the grid of what stands about the robot (`smal.clearance`). If a robot that follows it
touches nothing, nothing changes. Else every cell has a cost to go: the way to where the taught way leaves the grid,
dearer near what stands there, dearer the further it is from the taught way, and nowhere so far aside that the filter
would not know it. The robot then takes the short motion of its atoms that ends where least is left to go, of those
whose swept body is hit by nothing (after the dynamic window's global form, Brock and Khatib 1999).
"""

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.ndimage import distance_transform_edt
from scipy.sparse.csgraph import dijkstra

from smal.clearance import Floats, Surroundings
from smal.movement import Atom, dead_reckoning, turns_ahead

#: How far beside the taught way it may go, in radii of the robot: 2.4 m for one of 0.4 m, where views are still known.
_ASIDE: Final = 6.0
#: Distance from things beyond which more is of no use, in radii, and what a metre costs more right beside them.
_ROOM, _TIGHT_COST = 2.0, 2.0
#: What a metre costs more a radius beside the way, and over ground that nobody has seen.
_ASIDE_COST, _UNKNOWN_COST = 0.15, 0.5
#: Turns that are tried: half round to either side; and how far each then goes straight on, in radii: as far as it sees
#: what is in the way, since over a grid a late turn seems to be as short as an early one.
_MOST_TURN_RAD, _STRAIGHT = math.pi, 12.0
_STEPS: Final = ((1, 0), (0, 1), (1, 1), (1, -1))


class Avoidance:
    """Chooses motions of a robot's atoms: what each does between two frames, (5, 2), metres and radians."""

    def __init__(self, movements: Floats) -> None:
        self._movements = movements = movements.copy()
        if not turns_ahead(movements):
            # It creeps ahead in the first moment of a turn only, while it still brakes.
            movements[[Atom.LEFT, Atom.RIGHT], 0] = 0.0
        self._step_m = max(float(movements[Atom.FORWARD, 0]), 1e-3)
        self._turn_rad = max(abs(float(movements[Atom.LEFT, 1])), 1e-3)

    def is_hit(self, around: Surroundings, way: Floats) -> bool:
        """Tell whether a robot touches something that goes along places (s, 2), ahead and left of where it is now."""
        return bool((around.clearance_m[around.cells(_dense(way, around.cell_m))] < _body_m(around)).any())

    def turn_rad(self, around: Surroundings, way: Floats) -> float | None:
        """Return by how much to turn, to the left, to get round to where the way (s, 2) leads; None if nothing does."""
        to_go_m = self._to_go_m(around, way)
        count = round(_MOST_TURN_RAD / self._turn_rad)
        straight = max(2, round(_STRAIGHT * around.radius_m / self._step_m))
        here = around.cells(np.zeros(2))
        # Who stands too near to something may leave, and come no nearer.
        free = np.minimum(_body_m(around), around.clearance_m[here]) - 1e-3
        best_m, best_rad = math.inf, None
        for turns in sorted(range(-count, count + 1), key=abs):
            side = Atom.LEFT if turns > 0 else Atom.RIGHT
            atoms = np.array([side] * abs(turns) + [Atom.FORWARD] * straight + [Atom.STOP], dtype=np.int8)
            swept = dead_reckoning(atoms, self._movements)[1:, :2]
            cells = around.cells(swept)
            hit = around.clearance_m[cells] < free
            first = int(hit.argmax()) if hit.any() else len(hit)
            ends = slice(abs(turns), first)
            # A frame of turning costs as much as one of driving.
            left_m = to_go_m[cells][ends] + self._step_m * (np.arange(len(swept))[ends] + 1.0)
            if left_m.size and left_m.min() < best_m - 1e-9:
                best_m, best_rad = float(left_m.min()), turns * self._turn_rad
        return best_rad

    def _to_go_m(self, around: Surroundings, way: Floats) -> Floats:
        """Return what is left to go from every cell to where the way leaves the grid, metres; infinity from nowhere."""
        dense = _dense(way, around.cell_m)
        inside = np.abs(dense).max(axis=1) < around.reach_m / math.sqrt(2.0)
        dense = dense[: len(inside) if inside.all() else max(1, int(inside.argmin()))]
        track = np.full(around.clearance_m.shape, -1, dtype=np.intp)
        track[around.cells(dense)] = np.arange(len(dense))
        aside, (row, column) = distance_transform_edt(track < 0, return_indices=True)
        aside_m, along = aside * around.cell_m, track[row, column]
        here = around.cells(np.zeros(2))
        clear_m, body_m = around.clearance_m, _body_m(around)
        # A robot that stands too near to something, or too far aside, may leave.
        ours = np.hypot(around.x_m, around.y_m) < 1.5 * around.radius_m
        open_ = (clear_m >= body_m) | (ours & (clear_m >= clear_m[here] - 1e-3))
        open_ &= aside_m <= max(_ASIDE * around.radius_m, float(aside_m[here]) + around.radius_m)
        tight = np.clip((_ROOM * around.radius_m - clear_m) / (_ROOM * around.radius_m - body_m), 0.0, 1.0)
        cost = 1.0 + _TIGHT_COST * tight + _ASIDE_COST * aside_m / around.radius_m + _UNKNOWN_COST * around.unknown
        # Beyond the end of what is laid into the grid whatever is nearest to that end will do.
        last = along >= len(dense) - 1 - _ENDS
        return _distances(open_, cost * around.cell_m, open_ & last)


#: Cells of the way whose sides count as its end.
_ENDS: Final = 2


def _body_m(around: Surroundings) -> float:
    """Return how near to what stands there the robot's middle may come."""
    return around.radius_m + around.cell_m


def _dense(way: Floats, apart_m: float) -> Floats:
    """Return a way (s, 2) from the robot on, with places no further apart."""
    corners = np.concatenate([np.zeros((1, 2)), way])
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(corners, axis=0).T))])
    places = np.arange(0.0, along[-1] + apart_m / 2.0, apart_m / 2.0)
    return np.stack([np.interp(places, along, column) for column in corners.T], axis=1)


def _distances(open_: NDArray[np.bool_], cost_m: Floats, ends: NDArray[np.bool_]) -> Floats:
    """Return the cost of the cheapest way from every open cell to the next end, by Dijkstra over eight neighbours."""
    number = np.full(open_.shape, -1, dtype=np.intp)
    number[open_] = np.arange(int(open_.sum()))
    count = int(open_.sum())
    found = np.full(open_.shape, np.inf)
    if not ends.any():
        return found
    rows, columns, costs = [], [], []
    side = len(open_)
    for dx, dy in _STEPS:
        one = (slice(0, side - dx), slice(max(0, -dy), side - max(0, dy)))
        other = (slice(dx, side), slice(max(0, dy), side - max(0, -dy)))
        both = open_[one] & open_[other]
        rows.append(number[one][both])
        columns.append(number[other][both])
        costs.append((cost_m[one][both] + cost_m[other][both]) / 2.0 * math.hypot(dx, dy))
    goal = number[ends]
    rows.append(np.full(goal.size, count))
    columns.append(goal)
    costs.append(np.full(goal.size, 1e-9))
    graph = sparse.csr_array(
        (np.concatenate(costs), (np.concatenate(rows), np.concatenate(columns))), shape=(count + 1, count + 1)
    )
    found[open_] = dijkstra(graph, directed=False, indices=np.array([count]))[0, :count]
    return found

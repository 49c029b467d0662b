"""What to do: the atom that leads the likely places to the taught way, and along the shortest one to a goal.

The taught drives are a graph: keyframes, what follows each of them, and the places that drives share
(`smal.stitches`). Dijkstra's algorithm gives every keyframe its cost to go, the time to the nearest goal, and what is
best to follow from there: the drive that it is of, or another one that passes here and is there sooner. So a shorter
way is preferred, drives are joined to ways that nobody drove in one piece, and all of a belief that is spread over
drives wants the same. The robot steers in the mean direction of its likely places, each weighted by its probability
(after QMDP, Littman, Cassandra and Kaelbling 1995). If these directions disagree, or the robot is lost, it turns to
look.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import dijkstra

from smal.filter import Belief
from smal.movement import Atom, placed, seen_from, turns_ahead, wrapped
from smal.settings import SETTINGS
from smal.visual_map import VisualMap

Kind = Literal["follow", "look_around", "guess", "dead_end", "goal"]


@dataclass(frozen=True)
class Decision:
    """What to do until the next frame, and why.

    Parameters
    ----------
    kind : str
        "follow": along the taught way; "look_around": turn, since the belief is too wide; "guess": drive all the same,
        since looking has not helped; "dead_end": stop, since no taught way leads from here to the goal; "goal":
        arrived, and stop.
    atom : Atom
    heading_error_rad : float
        Mean direction to aim at less the heading.
    """

    kind: Kind
    atom: Atom
    heading_error_rad: float


class _Wish(NamedTuple):
    """What a belief wants: a direction less the heading, and whether its places agree on it and have a way.

    Whether it is likelier than not to have come to the end of a way that leads to the goal, and is sure to be there.
    """

    error_rad: float
    clear: bool
    way: bool
    ended: bool
    sure: bool


def chosen_goal(goals: Sequence[str], goal: str | None) -> str:
    """Return the goal that is meant.

    Raises
    ------
    ValueError
        There is none of that name, or none is named where there are several.
    """
    known = sorted(set(goals))
    if goal is None and len(known) > 1:
        raise ValueError(f"the model has the goals {', '.join(known)}; name one of them")
    if goal is not None and goal not in known:
        raise ValueError(f"the model has no goal {goal!r}; it has {', '.join(known)}")
    return known[0] if goal is None else goal


def cost_to_go(visual_map: VisualMap, goal: str) -> tuple[NDArray[np.float64], NDArray[np.intp]]:
    """Return the time to the goal from every keyframe (k,), and the keyframe to follow next (k,).

    The graph is deterministic and costs are positive, so that Dijkstra's algorithm is value iteration in the order in
    which values become final. The goal is the end of each drive that leads there. Going over to another drive costs
    the time for the turn and the way between the two, and `Settings.go_over_s`. A robot changes drives at the first
    shared place from which the goal is nearer: at the last one it would be torn between both. So the cost to go falls
    with every step, and nobody goes in circles.
    Where no way leads to the goal the time is infinite; there, and at goals, nothing is next (-1).
    """
    count = len(visual_map.keyframes)
    of = visual_map.key_drives
    on = np.flatnonzero(of[:-1] == of[1:])
    taken_s = np.diff(visual_map.keyframes)[on] * visual_map.tick_s
    goals = np.flatnonzero(np.append(of[:-1] != of[1:], True) & (visual_map.key_goals == goal))
    source, target = visual_map.stitched.T
    offsets = visual_map.stitch_offsets
    # From a node beyond all goals, against the way; 1e-9, since a sparse matrix has no edges of cost 0.
    rows = np.concatenate([on + 1, target, np.full(goals.size, count)])
    columns = np.concatenate([on, source, goals])
    turn_rad, ahead = (float(np.abs(column).max()) for column in visual_map.movements[:, ::-1].T)
    apart = np.hypot(*offsets[:, :2].T) / max(ahead, 1e-9) + np.abs(offsets[:, 2]) / max(turn_rad, 1e-9)
    costs = np.concatenate([taken_s, SETTINGS.go_over_s + apart * visual_map.tick_s, np.full(goals.size, 1e-9)])
    graph = sparse.csr_array((costs, (rows, columns)), shape=(count + 1, count + 1))
    found, previous = dijkstra(graph, indices=np.array([count]), return_predecessors=True)
    to_go_s, following = found[0, :-1], previous[0, :-1].astype(np.intp)
    following = np.where((following == count) | (following < 0), -1, following)
    goes_over_to = of.copy()
    for here in np.argsort(to_go_s):
        then = following[here]
        if then >= 0:
            goes_over_to[here] = of[then] if of[then] != of[here] else goes_over_to[then]
    for one, other in visual_map.stitched:
        if goes_over_to[one] == of[other] and to_go_s[other] < to_go_s[one]:
            following[one] = other
    return to_go_s, following


class Planner:
    """Turns beliefs into atoms.

    Parameters
    ----------
    visual_map : VisualMap
    goal : str, optional
        Where to go; may be left out where all drives lead to one goal.

    Raises
    ------
    ValueError
        No drive leads to the goal, or none is named where there are several.
    """

    def __init__(self, visual_map: VisualMap, goal: str | None = None) -> None:
        self._map = visual_map
        goal = chosen_goal(visual_map.goals, goal)
        # Turning begins where an atom of it makes the direction better, and ends where another one would not.
        self._turn_rad = abs(float(visual_map.movements[Atom.LEFT, 1])) or math.radians(5.0)
        self._ahead = SETTINGS.lookahead_s * visual_map.speed
        self._going = {Atom.FORWARD, Atom.LEFT, Atom.RIGHT} if turns_ahead(visual_map.movements) else {Atom.FORWARD}
        of = visual_map.key_drives
        self._start_frame = np.searchsorted(visual_map.drives, of, side="left")
        self._end_frame = np.searchsorted(visual_map.drives, of, side="right") - 1
        self._to_go_s, following = cost_to_go(visual_map, goal)
        self._keyframe, self._offset = self._followed(following)
        self._leads = visual_map.key_goals[self._keyframe] == goal
        self.reset()

    def _followed(self, following: NDArray[np.intp]) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
        """Return for each keyframe the one whose drive is to be followed there, and its own offset from that one."""
        keyframe, offset = np.arange(len(following)), np.zeros((len(following), 3))
        stitch = {(one, other): k for k, (one, other) in enumerate(self._map.stitched.tolist())}
        # What follows is nearer to the goal.
        for start in np.argsort(self._to_go_s).tolist():
            then = int(following[start])
            if (start, then) in stitch:
                keyframe[start] = keyframe[then]
                offset[start] = placed(self._map.stitch_offsets[stitch[start, then]], offset[then])
        return keyframe, offset

    def reset(self) -> None:
        """Forget what was being done, for a new episode."""
        self._turning: Atom | None = None
        self._looked_rad = self._guessed_s = self._followed_m = self._pending_rad = 0.0
        self.done = False

    def decide(self, belief: Belief, elapsed_s: float | None = None, delay_s: float = 0.0) -> Decision:
        """Say what to do until the next frame.

        Parameters
        ----------
        belief : Belief
        elapsed_s : float, optional
            Time since the frame before; a taught tick if not given.
        delay_s : float, optional
            Time from the frame to the moment when what is decided begins to move the robot; until then it goes on
            turning, if it turns, and would turn too far where that is not reckoned with.
        """
        elapsed_s = self._map.tick_s if elapsed_s is None else elapsed_s
        self._pending_rad = self._turn_rad * min(delay_s / self._map.tick_s, 1.0)
        wish = self._wish(belief)
        followed = belief.tracked > SETTINGS.followed * self._map.correlation_length
        followed |= self._looked_rad >= math.radians(SETTINGS.look_deg)
        self.done = self.done or (wish.ended and wish.sure and followed)
        kind = self._kind(wish, belief.lost > 0.5)
        return Decision(kind, self._atom(kind, wish.error_rad, elapsed_s), wish.error_rad)

    def _wish(self, belief: Belief) -> _Wish:
        """Return what the belief wants, each place weighted by its probability."""
        directions, left_to_go, to_end = self._directions(belief)
        # Places from which no way leads to the goal have no say.
        with_way = belief.weights * np.isfinite(self._to_go_s[belief.keyframes])
        share = float(with_way.sum())
        mean = complex((with_way * np.exp(1j * directions)).sum()) / max(share, 1e-12)
        leads = self._leads[belief.keyframes]
        at_goal = leads & (to_end < SETTINGS.goal_s * self._map.speed)
        # Beside or beyond the end by more than views change over, it is not at it.
        ended = leads & (to_end < self._map.correlation_length)
        ended &= left_to_go < 0.5 * self._map.speed * self._map.tick_s
        sure = float(belief.weights @ at_goal) * (1.0 - belief.lost) > SETTINGS.arrived
        clear = abs(mean) >= math.cos(math.radians(SETTINGS.wide_deg))
        return _Wish(math.atan2(mean.imag, mean.real), clear, share >= 0.5, float(belief.weights @ ended) > 0.5, sure)

    def _kind(self, wish: _Wish, lost: bool) -> Kind:
        """Choose what kind of decision is due."""
        if self.done:
            return "goal"
        clear = wish.way and wish.clear and not lost
        if clear and not wish.ended:
            return "follow"
        if self._looked_rad < math.radians(SETTINGS.look_deg):
            return "look_around"
        if clear:
            return "follow"
        return "guess" if wish.way or lost else "dead_end"

    def _atom(self, kind: Kind, error: float, elapsed_s: float) -> Atom:
        """Choose the atom of a decision."""
        if kind == "follow":
            return self._follow(error, elapsed_s)
        self._followed_m = 0.0
        if kind == "look_around":
            return self._look(error, elapsed_s)
        if kind == "guess":
            self._guessed_s += elapsed_s
            if self._guessed_s >= SETTINGS.guess_s:
                self._looked_rad = self._guessed_s = 0.0
            return self._steer(error)
        self._turning = None
        return Atom.STOP

    def _follow(self, error: float, elapsed_s: float) -> Atom:
        """Steer; after a correlation length of way it may look around again.

        Not before: a place that a few views look like would have it turn to and fro for ever.
        """
        atom = self._steer(error)
        self._followed_m += self._map.speed * elapsed_s if atom in self._going else 0.0
        if self._followed_m > self._map.correlation_length:
            self._looked_rad = self._guessed_s = 0.0
        return atom

    def _look(self, error: float, elapsed_s: float) -> Atom:
        """Turn to the side of a direction, then to the other; a car does so in bends, and once round in a circle."""
        before = self._looked_rad
        self._looked_rad += self._turn_rad * elapsed_s / self._map.tick_s
        if self._turning is None:
            self._turning = Atom.LEFT if error >= 0.0 else Atom.RIGHT
        if before < math.radians(SETTINGS.look_aside_deg) <= self._looked_rad:
            self._turning = Atom.RIGHT if self._turning is Atom.LEFT else Atom.LEFT
        return self._turning

    def _steer(self, error: float) -> Atom:
        """Turn while the direction is off by more than an atom of turning; drive straight on otherwise."""
        if self._turning is not None:
            error -= self._pending_rad if self._turning is Atom.LEFT else -self._pending_rad
        wanted = Atom.LEFT if error > 0.0 else Atom.RIGHT
        begins = self._turning is not wanted and abs(error) > self._turn_rad
        goes_on = self._turning is wanted and abs(error) > self._turn_rad / 2.0
        self._turning = wanted if begins or goes_on else None
        return self._turning or Atom.FORWARD

    def _directions(self, belief: Belief) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Return for each particle the direction to aim at less its heading, the way left, and how far the end is."""
        taught = self._map
        followed = self._keyframe[belief.keyframes]
        key = taught.keyframes[followed]
        ahead, left, turned = placed(belief.offsets, self._offset[belief.keyframes]).T
        along = taught.arc[key] + ahead
        start, end = self._start_frame[followed], self._end_frame[followed]
        # Another drive's frames, in axes of their own, come before and after.
        target = np.clip(np.searchsorted(taught.arc, along + self._ahead), start, end)
        # As seen from the keyframe.
        aim_ahead, aim_left, aim_turned = seen_from(taught.poses[target], taught.poses[key]).T
        x, y = aim_ahead - ahead, aim_left - left
        # Near its end a way has a heading, but no point ahead any more.
        near = np.hypot(x, y) < 0.3 * self._ahead
        aim = np.where(near, aim_turned, np.arctan2(y, x))
        last_ahead, last_left, _ = seen_from(taught.poses[end], taught.poses[key]).T
        return wrapped(aim - turned), taught.arc[end] - along, np.hypot(last_ahead - ahead, last_left - left)

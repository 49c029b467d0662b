"""What to do: the atom that leads the likely places to the taught way, and along the shortest one to a goal.

The robot steers to where its likely places aim, each weighted by its probability: by velocities, which are rolled out
(`smal.obstacles.motions`), or by atoms in the mean direction. If these directions disagree, or the robot is lost, it
turns to look. What stands in the way it goes round (`smal.obstacles.avoidance`), where it has a depth camera.
"""

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import connected_components

from smal.filter import Belief
from smal.model import VisualMap, in_common_axes, way_from
from smal.movement import Atom, placed, seen_from, turns_ahead, wrapped
from smal.obstacles.avoidance import way_round
from smal.obstacles.clearance import Surroundings
from smal.obstacles.motions import Chassis, Floats, Share
from smal.planning.cost_to_go import chosen_goal, cost_to_go
from smal.settings import SETTINGS
from smal.sought.sight import Glimpse

Kind = Literal["follow", "look_around", "guess", "dead_end", "blocked", "goal", "search", "blind"]
Said = Literal["found", "not_here"]


@dataclass(frozen=True)
class Decision:
    """What to do until the next frame, and why.

    Of its kinds "follow" is along the taught way; "look_around": turn, since places disagree; "guess": drive all the
    same, since looking has not helped; "dead_end": stop, since no taught way leads on to the goal; "blocked": stop,
    since something stands in the way and nothing leads round it; "search": arrived, and turn to see what is sought, or
    go up to it; "goal": stop, having said that it is found, or not here; "blind": stop, since no view has spoken for
    the robot's place for too long.
    """

    kind: Kind
    atom: Atom
    heading_error_rad: float  # Mean direction to aim at less the heading.
    #: What a robot does in the place of the atom that can be told velocities: linear and angular, as shares of its own.
    motion: Share


class Planner:
    """Turns beliefs into atoms that lead to a goal; see `chosen_goal` for the one that is meant."""

    def __init__(self, visual_map: VisualMap, goal: str | None = None) -> None:
        self._map = visual_map
        self._goal = chosen_goal(visual_map.goals, goal)
        self._turn_rad, self._ahead = visual_map.turn_rad, SETTINGS.lookahead_s * visual_map.speed
        car = turns_ahead(visual_map.movements)
        self._going = {Atom.FORWARD, Atom.LEFT, Atom.RIGHT} if car else {Atom.FORWARD}
        self._chassis = Chassis(visual_map.speed, self._turn_rad / visual_map.tick_s, car)
        self._open = np.zeros(len(visual_map.keyframes), dtype=np.bool_)
        self._plan(frozenset(), self._open)
        self.reset()

    def _plan(self, tried: frozenset[int], closed: NDArray[np.bool_]) -> None:
        """Plan the ways to all ends but those that were tried, by their drives; none goes on from a closed keyframe."""
        self._tried, self._closed = tried, closed
        self._to_go_s, following = cost_to_go(self._map, self._goal, tried, closed)
        self._guide, self._offset = self._guides(following)
        of = self._map.key_drives[self._guide]
        self._leads = (self._map.key_goals[self._guide] == self._goal) & ~np.isin(of, [*tried])

    def _guides(self, following: NDArray[np.intp]) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
        """Return for each keyframe the one whose drive is to be followed there, and its own offset from that one."""
        guide, offset = np.arange(len(following)), np.zeros((len(following), 3))
        stitch = {(one, other): k for k, (one, other) in enumerate(self._map.stitched.tolist())}
        # What follows is nearer to the goal.
        for start in np.argsort(self._to_go_s).tolist():
            then = int(following[start])
            if (start, then) in stitch:
                guide[start] = guide[then]
                offset[start] = placed(self._map.stitch_offsets[stitch[start, then]], offset[then])
        return guide, offset

    def reset(self) -> None:
        """Forget what was being done, for a new episode."""
        self._turning: Atom | None = None
        self._motion: Share = 0.0, 0.0
        self._looked_rad = self._guessed_s = self._driven = self._searched_s = self._neared_s = self._came_s = 0.0
        self._blocked_s = self._closed_s = 0.0
        self._toward_rad: float | None = None
        if self._tried or self._closed.any():
            self._plan(frozenset(), self._open)
        #: Whether it takes itself to be where it was taught that the goal is.
        self.arrived, self._ends = False, frozenset[int]()
        self.said: Said | None = None

    def decide(
        self,
        belief: Belief,
        elapsed_s: float | None = None,
        delay_s: float = 0.0,
        seen: Glimpse | None = None,
        around: Surroundings | None = None,
        strange: float = math.inf,
    ) -> Decision:
        """Say what to do until the next frame.

        `elapsed_s` is the time since the frame before, a taught tick if not given; `delay_s` that from the frame until
        what is decided moves the robot, which until then goes on as before. `seen` says whether what is
        sought is in view: it is found where it is as near as where the ways ended; a robot that has arrived, or nearly,
        goes up to it. Where nobody can tell, a robot that has arrived says that it has found it.
        With odometry, a robot that turns on the spot also goes round what stands in its way (`around`). Without that it
        drives slowly towards ground that looks so far away as none of the taught one (`strange`), and waits before it.
        """
        # A robot that hears nothing stands.
        times_s = self._map.tick_s if elapsed_s is None else elapsed_s, delay_s
        elapsed_s, delay_s = np.minimum(times_s, SETTINGS.stands_after_s).tolist()
        self._closed_s -= elapsed_s
        if self._closed_s < 0.0 and self._closed.any():
            self._plan(self._tried, self._open)
        directions, left_to_go, to_end = self._directions(belief)
        # Places from which no way leads to the goal have no say.
        say = belief.weights * np.isfinite(self._to_go_s[belief.keyframes])
        mean = complex((say * np.exp(1j * directions)).sum()) / max(float(say.sum()), 1e-12)
        error_rad = math.atan2(mean.imag, mean.real)
        lost, has_way = belief.lost > 0.5, float(say.sum()) >= 0.5
        clear = has_way and not lost and abs(mean) >= math.cos(math.radians(SETTINGS.wide_deg))
        looked, leads = self._looked_rad >= math.radians(SETTINGS.look_deg), self._leads[belief.keyframes]

        at_goal = float(belief.weights @ (leads & (to_end < SETTINGS.goal_s * self._map.speed)))
        tracked = belief.tracked > SETTINGS.tracked * self._map.correlation_length
        sure = (tracked or looked) and at_goal * (1.0 - belief.lost) > SETTINGS.arrived
        # Beside or beyond the end by more than views change over, it is not at it.
        at_end = leads & (to_end < self._map.correlation_length)
        at_end &= left_to_go < 0.5 * self._map.speed * self._map.tick_s
        ended = float(belief.weights @ at_end) > 0.5
        if not self.arrived and ended and sure:
            self.arrived, self._ends, self._neared_s = True, self._ends_here(belief), 0.0
        if self.said is None:
            self._say(belief, elapsed_s, seen, sure, around)

        kind = self._unless_blind(self._kind(clear and (looked or not ended), looked, has_way or lost), looked, belief)
        if kind == "search":
            error_rad = self._toward_rad or 0.0
            directions = np.full(say.shape, error_rad)
        if not self._map.odometry or self._chassis.car:
            around = None
        wanted_rad = error_rad
        if around is not None and has_way and kind in ("follow", "guess"):
            way, step_m = self._way_ahead(belief, around.reach_m), self._map.speed * self._map.tick_s
            round_rad = way_round(around, way, self._turn_rad, step_m, self._map.correlation_length, error_rad)
            kind, error_rad = ("blocked", error_rad) if round_rad is None else (kind, round_rad)
        kind, slow = self._strange(kind, error_rad, strange if around is None else math.inf, seen)
        to_turn_rad = error_rad - self._turn_rad * min(delay_s / self._map.tick_s, 1.0) * self._motion[1]
        atom, free_m = self._atom(kind, to_turn_rad, elapsed_s), around.free_m(ahead=True) if around else math.inf
        if atom is Atom.FORWARD and free_m == 0.0:
            self._turning = Atom.LEFT if to_turn_rad > 0.0 else Atom.RIGHT
            self._turning = self._turning if abs(to_turn_rad) >= self._turn_rad / 2.0 else None
            kind, atom = (kind, self._turning) if self._turning else ("blocked", Atom.STOP)
        if kind == "blocked":
            atom = self._wait(belief, elapsed_s, around)
        elif atom in self._going:
            self._blocked_s = 0.0
        # Round things, and before those that are near, it goes turn by turn.
        drives = kind in ("follow", "guess") or (kind == "search" and self._toward_rad is not None)
        aims = directions if drives and error_rad == wanted_rad and free_m > self._ahead else None
        linear, angular = self._chassis.choose(atom, aims, say + 1e-9, self._motion, delay_s)
        self._motion = slow * linear, (slow or 1.0) * angular
        return Decision(kind, atom, error_rad, self._motion)

    def _strange(self, kind: Kind, error_rad: float, strange: float, seen: Glimpse | None) -> tuple[Kind, float]:
        """Return what to do before ground that looks strange so far ahead, and at which share of the speed.

        What is sought is not in the way.
        """
        goes = kind in ("follow", "guess") or (kind == "look_around" and self._chassis.car)
        if not goes or (seen is not None and seen.probability > 0.5):
            return kind, 1.0
        if strange < SETTINGS.stops_s * self._map.speed:
            # It looks there before it waits.
            aside = abs(error_rad) > math.radians(SETTINGS.spacing_deg) and not self._chassis.car
            return (kind, 0.0) if aside else ("blocked", 1.0)
        return kind, SETTINGS.slowly if strange < SETTINGS.slows_s * self._map.speed else 1.0

    def _kind(self, clear: bool, looked: bool, guesses: bool) -> Kind:
        """Say what to do if nothing stands in the way: where what to do is clear, or it has looked, or may guess."""
        if self.said is not None:
            return "goal"
        if self.arrived or self._toward_rad is not None:
            return "search"
        if clear and (looked or self._blocked_s < 2.0 * SETTINGS.waits_s):
            return "follow"
        if not looked:
            return "look_around"
        if guesses:
            return "guess"
        self.said = "not_here" if self._tried else None
        return "dead_end"

    def _unless_blind(self, kind: Kind, looked: bool, belief: Belief) -> Kind:
        """Return what to do instead if no view has spoken for the robot's place for too long.

        It looks around first, if its camera shows anything and it has driven since it last did. So it never drives far
        without a view that it knows.
        """
        sees = belief.camera == "sees"
        moves = kind in ("follow", "guess") or (not sees and kind in ("look_around", "search"))
        if not moves or belief.unseen <= SETTINGS.blind_s * self._map.speed:
            return kind
        if self._driven > 0.0 or self._guessed_s > 0.0:
            self._looked_rad = self._guessed_s = 0.0
            looked = False
        return "look_around" if sees and not looked else "blind"

    def _say(
        self, belief: Belief, elapsed_s: float, seen: Glimpse | None, sure: bool, around: Surroundings | None
    ) -> None:
        """Say that it is found, if it is, or search; it may be `sure` to be at the goal before it has arrived."""
        # What has come where it was free only looks like what is sought, and may hide it.
        self._came_s = max(self._came_s - elapsed_s, 0.0)
        if seen is not None and seen.left is not None and around is not None and around.has_come(self._off(seen)):
            self._came_s = SETTINGS.same_moment_s
        sees = seen is None or (
            seen.probability > SETTINGS.false_seen / (1.0 + SETTINGS.false_seen) and not self._came_s
        )
        near = math.inf if seen is None else seen.near
        # Who has arrived looks from where nobody drove, where less of it may show.
        about_as_near = near > 1.0 / SETTINGS.as_near
        beside = seen is not None and sure and about_as_near
        self._toward_rad = None
        if sees and ((self.arrived and about_as_near) or (beside and near > 1.0)):
            self.said = "found"
        elif sees and seen and seen.left is not None and (self.arrived or beside) and self._neared_s < SETTINGS.goal_s:
            self._toward_rad = self._off(seen)
        elif self.arrived:
            self._search(belief, 0.0 if self._came_s else elapsed_s)

    def _off(self, seen: Glimpse) -> float:
        """Return how far to the left of ahead is what a view shows, radians."""
        return (seen.left or 0.0) * math.radians(self._map.scene[0])

    def _search(self, belief: Belief, elapsed_s: float) -> None:
        """Look all around, whatever other place that looks like; then go to another end, or say "not here"."""
        self._searched_s += elapsed_s
        around_s = math.radians(SETTINGS.search_deg) / self._turn_rad * self._map.tick_s
        # One that turns ahead would leave the place.
        if self._searched_s < (SETTINGS.stands_s if self._chassis.car else around_s):
            return
        self._plan(self._tried | self._ends, self._closed)
        self.arrived, self._searched_s, self._neared_s = False, 0.0, 0.0
        if float(belief.weights @ np.isfinite(self._to_go_s[belief.keyframes])) < 0.5:
            self.said = "not_here"

    def _ends_here(self, belief: Belief) -> frozenset[int]:
        """Return the drives that end where the robot is, and beside it."""
        taught, poses = self._map, in_common_axes(self._map)
        here = int(taught.key_drives[self._guide[belief.keyframes[belief.weights.argmax()]]])
        last = np.unique(taught.key_range[1])
        away = np.hypot(*(poses[last] - poses[last[taught.key_drives[last] == here]])[:, :2].T)
        # Drives that share no place are in axes of their own.
        one, other = taught.key_drives[taught.stitched].T
        links = sparse.csr_array((np.ones(one.size), (one, other)), shape=(len(taught.goals),) * 2)
        group = connected_components(links, directed=False)[1]
        near = (away < 2.0 * SETTINGS.goal_s * taught.speed) & (group[taught.key_drives[last]] == group[here])
        return frozenset(taught.key_drives[last[near]].tolist()) | {here}

    def _wait(self, belief: Belief, elapsed_s: float, around: Surroundings | None) -> Atom:
        """Wait before what nothing leads round, and keep in view who moves there; then make room for them.

        People wait for it as it waits for them: one has to give way. Who waits in vain may be elsewhere than it
        believes: it looks around, once. Then it takes another taught way.
        """
        waited, self._blocked_s = self._blocked_s // SETTINGS.waits_s, self._blocked_s + elapsed_s
        if waited == 1.0 < self._blocked_s // SETTINGS.waits_s:
            self._looked_rad = 0.0
        elif waited == 2.0 < self._blocked_s // SETTINGS.waits_s:
            self._close(belief, around.reach_m if around else SETTINGS.slows_s * self._map.speed)
        aside_rad = around.moving_rad if around else 0.0
        if abs(aside_rad) <= math.radians(self._map.scene[0]) / 4.0:
            makes_room = waited and around and around.crowded and around.free_m(ahead=False) > 0.0
            return Atom.BACKWARD if makes_room else Atom.STOP
        return Atom.LEFT if aside_rad > 0.0 else Atom.RIGHT

    def _close(self, belief: Belief, reach: float) -> None:
        """Close the way ahead for a while, if another one leads to the goal."""
        taught, here = self._map, self._guide[belief.keyframes[belief.weights.argmax()]]
        along = taught.arc[taught.keyframes] - taught.arc[taught.keyframes[here]]
        ahead = (taught.key_drives == taught.key_drives[here]) & (along >= 0.0) & (along < reach)
        closed = self._closed
        self._plan(self._tried, closed | ahead)
        if float(belief.weights @ np.isfinite(self._to_go_s[belief.keyframes])) < 0.5:
            self._plan(self._tried, closed)
        else:
            self._closed_s, self._blocked_s = SETTINGS.closed_s, 0.0

    def _atom(self, kind: Kind, to_turn_rad: float, elapsed_s: float) -> Atom:
        """Choose the atom of a decision, and count the way, the turn or the time of what goes on."""
        if kind != "follow":
            self._driven = 0.0
        if kind in ("goal", "dead_end", "blocked", "blind"):
            self._turning = None
            return Atom.STOP
        if kind == "search" and self._toward_rad is None:
            self._turning = None if self._chassis.car else Atom.LEFT
            return self._turning or Atom.STOP
        if kind == "look_around":
            return self._look(to_turn_rad, elapsed_s)
        atom = self._steer(to_turn_rad, elapsed_s)
        if kind == "search":  # Half as long as it may go ahead it may turn.
            self._neared_s += elapsed_s * (1.0 + max(float(atom in self._going), self._motion[0])) / 2.0
        elif kind == "guess":
            self._guessed_s += elapsed_s
        elif atom in self._going:
            self._driven += self._map.speed * elapsed_s
        # Not before: a place that a few views look like would have it turn to and fro for ever.
        if self._driven > self._map.correlation_length or self._guessed_s >= SETTINGS.guess_s:
            self._looked_rad = self._guessed_s = 0.0
        return atom

    def _look(self, to_turn_rad: float, elapsed_s: float) -> Atom:
        """Turn to the side of a direction, then to the other; a car does so in bends, and once round in a circle."""
        before = self._looked_rad
        self._looked_rad += self._chassis.of_atom(Atom.LEFT)[1] * self._turn_rad * elapsed_s / self._map.tick_s
        if self._turning is None:
            self._turning = Atom.LEFT if to_turn_rad >= 0.0 else Atom.RIGHT
        if before < math.radians(SETTINGS.look_aside_deg) <= self._looked_rad:
            self._turning = Atom.RIGHT if self._turning is Atom.LEFT else Atom.LEFT
        return self._turning

    def _steer(self, to_turn_rad: float, elapsed_s: float) -> Atom:
        """Begin to turn where the direction is off by more than an atom, go on until half of one; else drive on."""
        # At a low rate a turn until the next frame is longer: it must not lead further to the other side.
        wanted = Atom.LEFT if to_turn_rad > 0.0 else Atom.RIGHT
        least = 0.5 if self._turning is wanted else 1.0
        least = self._turn_rad * max(least, 0.5 * elapsed_s / self._map.tick_s)
        self._turning = wanted if abs(to_turn_rad) > least else None
        return self._turning or Atom.FORWARD

    def _way_ahead(self, belief: Belief, reach: float) -> NDArray[np.float64]:
        """Return places (s, 2) of the way from where it aims on, ahead of and left of the robot's likeliest place."""
        best = belief.weights.argmax()
        here = belief.keyframes[best]
        along = np.arange(self._ahead, self._ahead + reach, max(self._ahead / 4.0, reach / 100.0))
        return way_from(self._map, self._guide[here], placed(belief.offsets[best], self._offset[here]), along)

    def _directions(self, belief: Belief) -> tuple[Floats, Floats, Floats]:
        """Return for each particle the direction to aim at less its heading, the way left, and how far the end is."""
        taught = self._map
        guide = self._guide[belief.keyframes]
        key, drive = taught.keyframes[guide], taught.key_drives[guide]
        ahead, left, turned = placed(belief.offsets, self._offset[belief.keyframes]).T
        along = taught.arc[key] + ahead
        start, end = (np.searchsorted(taught.drives, drive, side) for side in ("left", "right"))
        # Another drive's frames, in axes of their own, come before and after.
        target = np.clip(np.searchsorted(taught.arc, along + self._ahead), start, end - 1)
        # As seen from the keyframe.
        aim_ahead, aim_left, aim_turned = seen_from(taught.poses[target], taught.poses[key]).T
        x, y = aim_ahead - ahead, aim_left - left
        # Near its end a way has a heading, but no point ahead any more.
        near = np.hypot(x, y) < 0.3 * self._ahead
        aim = np.where(near, aim_turned, np.arctan2(y, x))
        last_ahead, last_left, _ = seen_from(taught.poses[end - 1], taught.poses[key]).T
        return wrapped(aim - turned), taught.arc[end - 1] - along, np.hypot(last_ahead - ahead, last_left - left)

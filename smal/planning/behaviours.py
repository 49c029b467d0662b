"""The behaviours of a robot on the way to its goal, in their order of priority.

In every frame each behaviour first updates its clock by the last motion of the robot, and `Search`
judges whether the result is certain. Then the first behaviour with a proposal decides: `Done`,
`Search`, `Blind`, `BackOff`, `Follow`, `LookAround`, `Guess`, `DeadEnd`. If an obstacle blocks the
proposal, `Wait` changes it.
"""

import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from smal.arrays import Floats
from smal.filter import Belief
from smal.map import VisualMap, in_common_axes
from smal.movement import STANDS, Motion
from smal.obstacles.avoidance import Turns, detour_turn
from smal.obstacles.clearance import Surroundings
from smal.planning.route import Route
from smal.planning.steering import Chassis, Intent, Kind
from smal.target.detector import TargetEstimate

Said = Literal["found", "not_here"]


@dataclass(frozen=True)
class Situation:
    """Input of the behaviours: the current frame, and the motion since the frame before.

    Attributes
    ----------
    belief, target, around, unexpected_ground, elapsed_s
        As in `Planner.decide`.
    doing, motion
        Kind and motion of the last decision.
    turned_rad
        Turn to the left by that motion.
    directions, weights
        Direction (p,) to each particle's aim, and its weight (p,); 0 without a way to the goal.
    heading_rad, underway_rad
        Mean direction; and turn by the last decision until the new decision moves the robot.
    has_way
        Whether a taught way leads to the goal from the robot's probable place.
    clear
        Whether the directions agree and the robot is not lost.
    at_goal, at_end
        Probability of being near the goal; and whether the robot is probably at the end of the way.
    unseen
        Whether the robot has driven too far without a view that supports its place.
    supported
        Whether the views since the robot was lost are decisive evidence for its place.
    held
        Whether an obstacle stopped the robot on its way ahead; None if unknown.
    """

    belief: Belief
    target: TargetEstimate | None
    around: Surroundings | None
    unexpected_ground: float
    elapsed_s: float
    doing: Kind | None
    motion: Motion
    turned_rad: float
    directions: Floats
    weights: Floats
    heading_rad: float
    underway_rad: float
    has_way: bool
    clear: bool
    at_goal: float
    at_end: bool
    unseen: bool
    supported: bool
    held: bool | None

    @property
    def lost(self) -> bool:
        """Whether the robot is more likely lost than not."""
        return self.belief.is_lost

    @property
    def sees(self) -> bool:
        """Whether the camera provides views."""
        return self.belief.camera == "sees"


class Mission:
    """The task of the robot: its route, and the announced result."""

    def __init__(self, route: Route) -> None:
        self.route = route
        self.said: Said | None = None


class Behaviour:
    """A way to act, with its own clock."""

    def note(self, now: Situation) -> None:
        """Update the clock by the motion since the frame before."""

    def propose(self, now: Situation) -> Intent | None:
        """Return the intent until the next frame; None defers to the behaviours of lower priority."""

    def instead_of(self, intent: Intent, now: Situation) -> Intent:
        """Return the decided intent, or a replacement."""
        return intent


class Done(Behaviour):
    """Stand after the result was announced."""

    def __init__(self, mission: Mission) -> None:
        self._mission = mission

    def propose(self, now: Situation) -> Intent | None:
        """Stand for good."""
        return None if self._mission.said is None else Intent("goal", STANDS)


class LookAround(Behaviour):
    """Turn to one side, then to the other, and once round to the start.

    It is due again when the robot has followed the way for a correlation length, or guessed for
    `PlannerConfig.guess_s` and the time to turn round. An earlier repetition can turn the robot to and fro for ever at
    an ambiguous place. It is also due when no view supports the robot's place any more, and at the end of the way if
    the robot has looked around at another place.
    """

    def __init__(self, taught: VisualMap, chassis: Chassis) -> None:
        self._config = chassis.config
        self._chassis = chassis
        self._length = taught.correlation_length
        self._side = 1.0
        self._apart = taught.config.elsewhere * taught.correlation_length
        self._places = in_common_axes(taught)[:, :2]
        self._place = self._places[0]
        self._turned_here_rad = 0.0
        self.again()

    @property
    def done(self) -> bool:
        """Whether the robot has looked all around since it last drove."""
        return self._turned_rad >= self._config.look_rad

    @property
    def done_here(self) -> bool:
        """Whether the robot has looked all around at its estimated place: views of another place are no evidence."""
        return self._turned_here_rad >= self._config.look_rad

    def again(self) -> None:
        """Reset, so that the robot looks around again."""
        self._turned_rad = 0.0
        self._turned_here_rad = 0.0
        self._followed = 0.0
        self._guessed_s = 0.0

    def note(self, now: Situation) -> None:
        """Count the turn, and the way since the robot looked around."""
        self._stay_or_begin(now.belief)
        if now.doing == "look_around":
            self._turn(abs(now.turned_rad))
        ahead = self._chassis.speed * max(now.motion[0], 0.0) * now.elapsed_s
        self._followed = self._followed + ahead if now.doing == "follow" else 0.0
        self._guessed_s += now.elapsed_s if now.doing == "guess" else 0.0
        turned_s = math.pi / self._chassis.turn_rad_s  # Time to turn to any direction.
        guessed = self._guessed_s >= turned_s + self._config.guess_s
        due = self._followed > self._length or guessed
        elsewhere = now.at_end and self.done and not self.done_here
        if due or elsewhere or (now.unseen and max(self._followed, self._guessed_s) > 0.0):
            self.again()

    def _stay_or_begin(self, belief: Belief) -> None:
        """Count the turn from the start if the robot's estimated place has changed."""
        apart = np.hypot(*(self._places[belief.keyframes] - self._place).T)
        if float(belief.weights @ (apart < self._apart)) < 0.5:
            self._place = self._places[belief.keyframes[belief.weights.argmax()]]
            self._turned_here_rad = 0.0

    def _turn(self, turned_rad: float) -> None:
        before = self._turned_rad
        self._turned_rad += turned_rad
        self._turned_here_rad += turned_rad
        if before < math.radians(self._config.look_aside_deg) <= self._turned_rad:
            self._side = -self._side

    def propose(self, now: Situation) -> Intent | None:
        """Turn, unless the robot has looked around."""
        if self.done:
            return None
        if self._turned_rad == 0.0:
            self._side = math.copysign(1.0, now.heading_rad - now.underway_rad)
        return Intent("look_around", self._chassis.turn(self._side), now.heading_rad)


class Search(Behaviour):
    """Search the target at the end of the way, approach it, and judge the result.

    Before arrival, the robot already approaches a target that is as near as at the end of the taught ways.
    """

    def __init__(
        self,
        taught: VisualMap,
        chassis: Chassis,
        mission: Mission,
        look: LookAround,
        back_off: "BackOff",
    ) -> None:
        self._config = chassis.config
        self._taught = taught
        self._chassis = chassis
        self._mission = mission
        self._look = look
        self._back_off = back_off
        #: Whether the robot estimates to be at the taught goal.
        self.arrived = False
        self._ends = frozenset[int]()
        self._searched_s = 0.0
        self._neared_s = 0.0
        self._came_s = 0.0
        self._hidden_s = 0.0
        self._nears = False  # Whether the robot approaches the target.

    def note(self, now: Situation) -> None:
        """Count the time of approaching, of searching, and of waiting before an obstacle that hides the target."""
        if self._nears:
            # Turning, or waiting before an obstacle, counts half.
            self._neared_s += now.elapsed_s * (1.0 + max(now.motion[0], 0.0)) / 2.0
        elif now.doing == "search" and not self._hidden:
            self._searched_s += now.elapsed_s
        self._hidden_s += now.elapsed_s if self._came_s else 0.0
        # An obstacle that appeared in free space can resemble the target, and can hide it.
        self._came_s = max(self._came_s - now.elapsed_s, 0.0)
        target_rad = self._target_rad(now)
        if now.around and target_rad is not None and now.around.is_new(target_rad):
            self._came_s = self._config.moment_s

    @property
    def _hidden(self) -> bool:
        """Whether the robot waits for an obstacle that hides the target to leave; a car cannot look at other places."""
        waits = self._chassis.car or self._hidden_s < self._config.waits_s
        return self._came_s > 0.0 and waits

    def _target_rad(self, now: Situation) -> float | None:
        """Return the direction to the target in view; out of view, to its taught place ahead of the end of the way."""
        if now.target is not None and now.target.left is not None:
            return self._off_rad(now.target.left)
        in_field = abs(now.heading_rad) < self._taught.field_rad / 2.0
        return now.heading_rad if self.arrived and now.at_end and in_field else None

    def judge(self, now: Situation) -> Said | None:
        """Return the certain result, if any; otherwise decide whether to approach, or to go on to another end."""
        as_near_as_it_can = self._as_near_as_it_can(now)
        self._nears = False
        if now.unseen and not now.sees:
            return None
        sure = self._sure(now)
        if not self.arrived and now.at_end and sure:
            self._arrive(now.belief)
        if self._finds(now.target, sure, as_near_as_it_can):
            return "found"
        self._nears = self._may_approach(now.target, sure)
        if self.arrived:
            return None if self._nears else self._leave(now.belief)
        stuck = not (now.has_way or now.lost or now.unseen) and self._look.done
        return "not_here" if stuck and self._mission.route.tried else None

    def propose(self, now: Situation) -> Intent | None:
        """Approach the visible target, or search it at the end of the way: turn once round, whatever the belief."""
        if now.unseen and not now.sees:
            return None
        if self._nears and now.target is not None and now.target.left is not None:
            heading_rad = self._off_rad(now.target.left)
            return Intent("search", None, heading_rad, np.array([heading_rad]), np.ones(1))
        if not self.arrived:
            return None
        stands = self._hidden or self._chassis.car
        return Intent("search", STANDS if stands else self._chassis.turn(1.0))

    def _sure(self, now: Situation) -> bool:
        """Return whether the robot is certainly near the goal, after tracking the way or looking around.

        If nothing stands out at the end of the way, its views are no evidence, so that only tracking counts.
        """
        followed = now.belief.tracked > self._config.tracked * self._taught.correlation_length
        looked = now.target is not None and self._look.done_here
        at_goal = now.at_goal * (1.0 - now.belief.lost)
        return (followed or looked) and at_goal > self._config.arrived

    def _as_near_as_it_can(self, now: Situation) -> bool:
        """Return whether an obstacle, such as the target itself, stops the approach."""
        return self._nears and (now.doing == "blocked" or self._back_off.begins)

    def _finds(self, target: TargetEstimate | None, sure: bool, as_near_as_it_can: bool) -> bool:
        """Return whether the target is in view, and about as near as where the taught ways ended."""
        if target is None:
            return self.arrived
        as_near = self._config.as_near_as_it_can if as_near_as_it_can else self._config.as_near
        near = self.arrived and target.near > 1.0 / as_near
        return self._in_view(target) and (near or (sure and target.near > 1.0))

    def _may_approach(self, target: TargetEstimate | None, sure: bool) -> bool:
        if target is None or target.left is None or not self._in_view(target):
            return False
        in_reach = self.arrived or (sure and self._is_near(target))
        return in_reach and self._neared_s < self._config.goal_s

    def _in_view(self, target: TargetEstimate) -> bool:
        return target.probability > self._config.in_view and not self._came_s

    def _is_near(self, target: TargetEstimate) -> bool:
        """Return whether the target is about as near as taught: from an untaught pose less of it can be visible."""
        return target.near > 1.0 / self._config.as_near

    def _arrive(self, belief: Belief) -> None:
        self.arrived = True
        distance = self._config.found_s * self._taught.speed
        self._ends = self._mission.route.ends_near(belief, distance)
        self._neared_s = 0.0
        self._searched_s = 0.0
        self._hidden_s = 0.0

    def _leave(self, belief: Belief) -> Said | None:
        """After the search, drive on to another end; without any the target is not here."""
        around_s = self._config.search_rad(self._taught.field_rad) / self._chassis.turn_rad_s
        # A car cannot turn without leaving the place.
        if self._searched_s < (self._config.stands_s if self._chassis.car else around_s):
            return None
        self.arrived = False
        self._neared_s = 0.0
        self._mission.route = self._mission.route.beyond(self._ends)
        return None if self._mission.route.has_way(belief) else "not_here"

    def _off_rad(self, left: float) -> float:
        """Return the direction of an image position, positive to the left of ahead, radians."""
        return left * self._taught.field_rad


class Blind(Behaviour):
    """Stand after driving too far without a view that supports the robot's place, once it has looked around.

    It looks around again after `PlannerConfig.blind_again_s`: the light can have changed, or somebody can have carried
    the robot back. A camera that shows nothing can face a plain wall. Therefore the robot then looks around too, but
    only once: if no direction shows anything, the camera has failed.
    """

    def __init__(self, chassis: Chassis, look: LookAround) -> None:
        self._look = look
        self._again_s = chassis.config.blind_again_s
        self._stands_s = 0.0
        #: Whether the robot has looked around since the camera last showed anything.
        self._tried = False

    def note(self, now: Situation) -> None:
        """Count the time for which the robot stands; when due, look around."""
        self._tried = self._tried and not now.sees
        self._stands_s = self._stands_s + now.elapsed_s if now.doing == "blind" else 0.0
        if self._stands_s >= self._again_s and not self._tried:
            self._tried = not now.sees
            self._look.again()

    def propose(self, now: Situation) -> Intent | None:
        """Stand, unless looking around can help."""
        waits = self._look.done or not (now.sees or self._tried)
        return Intent("blind", STANDS, now.heading_rad) if now.unseen and waits else None


class BackOff(Behaviour):
    """Back off the way the robot came if an obstacle stops it although it drives ahead.

    The robot has touched something, or its guard sees what the grid of the planner does not contain. Only a robot with
    odometry, or with a guard, notices. The more often something stops it here, the more likely it is elsewhere: at the
    second time it looks around, and again whenever the number has doubled.
    """

    def __init__(self, chassis: Chassis, look: LookAround) -> None:
        self._chassis = chassis
        self._look = look
        self._held_s = 0.0
        self._backs_s = 0.0
        self._driven = math.inf  # Way ahead since the robot last backed off.
        self._in_vain = False

    @property
    def begins(self) -> bool:
        """Whether the robot begins to back off at this frame."""
        return self._backs_s == self._chassis.config.stalls_s

    def note(self, now: Situation) -> None:
        """Count the time for which an obstacle stops the robot."""
        self._backs_s = max(self._backs_s - now.elapsed_s, 0.0)
        if now.held is None or now.around is None:
            return
        self._held_s = self._held_s + now.elapsed_s if now.held else 0.0
        self._driven += now.belief.moved or 0.0
        if self._held_s < self._chassis.config.stalls_s:
            return
        touched = now.around.touch()
        self._in_vain = touched > 1 and touched.bit_count() == 1
        if self._in_vain:
            self._look.again()
        self._held_s = 0.0
        self._backs_s = self._chassis.config.stalls_s
        self._driven = 0.0

    def propose(self, now: Situation) -> Intent | None:
        """Back off as far as the space behind is known to be free, then look around if due."""
        if self._driven >= self._chassis.lookahead:
            return None
        behind_m = now.around.free_m(ahead=False) if now.around else 0.0
        if self._backs_s > 0.0 and behind_m > 0.0:
            return Intent("blocked", (-1.0, 0.0), now.heading_rad)
        return self._look.propose(now) if self._in_vain else None


class Follow(Behaviour):
    """Drive along the taught way if the direction is clear."""

    def __init__(self, look: LookAround, wait: "Wait") -> None:
        self._look = look
        self._wait = wait

    def propose(self, now: Situation) -> Intent | None:
        """Drive, unless the robot must look around first."""
        doubts = now.at_end or self._wait.in_vain or not now.supported
        goes = now.clear and not now.unseen and (self._look.done or not doubts)
        if not goes:
            return None
        return Intent("follow", None, now.heading_rad, now.directions, now.weights)


class Guess(Behaviour):
    """Drive in the most probable direction if looking around has not resolved the ambiguity.

    The direction stays as chosen, by the executed turns: while the robot turns, the belief changes,
    and a robot that follows it can turn for ever.
    """

    def __init__(self, chassis: Chassis) -> None:
        self._chassis = chassis
        self._heading_rad: float | None = None

    def note(self, now: Situation) -> None:
        """Follow the robot's turn."""
        if now.doing != "guess":
            self._heading_rad = None
        elif self._heading_rad is not None:
            self._heading_rad -= now.turned_rad

    def propose(self, now: Situation) -> Intent | None:
        """Turn to the direction, and drive straight."""
        if not (now.has_way or now.lost):
            return None
        if self._heading_rad is None:
            self._heading_rad = self._likeliest_rad(now)
        return Intent("guess", None, self._heading_rad, stepwise=True)

    def _likeliest_rad(self, now: Situation) -> float:
        """Return the direction with which most of the weight agrees."""
        apart = np.cos(now.directions[:, None] - now.directions)
        agree = apart >= math.cos(math.radians(self._chassis.config.wide_deg))
        return float(now.directions[(agree @ now.weights).argmax()])


class DeadEnd(Behaviour):
    """Stand if no taught way leads on to the goal."""

    def propose(self, now: Situation) -> Intent | None:
        """Stand."""
        return Intent("dead_end", STANDS, now.heading_rad)


class Wait(Behaviour):
    """Drive around an obstacle, or wait before it.

    A person waits for the robot while it waits for the person. Therefore the robot backs up after
    `PlannerConfig.waits_s`, and forgets what it has touched, which can have left. A robot that waits
    in vain can be elsewhere than estimated: after twice that time it looks around, once. After three
    times it takes another taught way, if any, for `PlannerConfig.closed_s`.
    Only a robot with odometry that turns on the spot drives around obstacles.
    """

    def __init__(
        self, taught: VisualMap, chassis: Chassis, mission: Mission, look: LookAround
    ) -> None:
        self._config = chassis.config
        self._taught = taught
        self._chassis = chassis
        self._mission = mission
        self._look = look
        self._goes_round = taught.odometry and not chassis.car
        self._blocked_s = 0.0
        self._closed_s = 0.0
        self._evades = False  # Whether the last proposal led around an obstacle.

    @property
    def in_vain(self) -> bool:
        """Whether the robot has waited so long that its estimated place can be wrong."""
        return self._periods >= 2

    @property
    def _periods(self) -> int:
        return int(self._blocked_s // self._config.waits_s)

    def note(self, now: Situation) -> None:
        """Count how long the way is blocked; when due, look around or take another way."""
        self._closed_s -= now.elapsed_s
        if self._closed_s < 0.0 and self._mission.route.closed.any():
            self._mission.route = self._mission.route.reopened()
        before = self._periods
        if now.doing == "blocked":
            self._blocked_s += now.elapsed_s
        elif now.motion[0] > 0.0:
            self._blocked_s = 0.0
        if before == 0 < self._periods and now.around:
            now.around.release()
        if before == 1 < self._periods:
            self._look.again()
        elif before == 2 < self._periods:
            self._take_another_way(now)

    def _take_another_way(self, now: Situation) -> None:
        around = self._things(now)
        reach = around.reach_m if around else self._config.slows_s * self._chassis.speed
        other = self._mission.route.around(now.belief, reach)
        if other is not None:
            self._mission.route = other
            self._closed_s = self._config.closed_s
            self._blocked_s = 0.0

    def instead_of(self, intent: Intent, now: Situation) -> Intent:
        """Return the intent, or a replacement if an obstacle blocks it."""
        around = self._things(now)
        if around is None or not around.has_camera:
            intent = self._before_unexpected_ground(intent, now)
        if around is None or intent.motion is not None:
            return intent
        return self._among_things(intent, now, around)

    def _things(self, now: Situation) -> Surroundings | None:
        """Return the obstacles if the robot can drive around them; otherwise None."""
        return now.around if self._goes_round else None

    def _among_things(self, intent: Intent, now: Situation, around: Surroundings) -> Intent:
        """Drive around obstacles; near to them turn on the spot, and drive only straight."""
        if intent.kind != "search" and now.has_way:
            round_rad = self._round_rad(intent.heading_rad, now.belief, around)
            if round_rad is None:
                return self._wait(now)
            if round_rad != intent.heading_rad:
                intent = replace(intent, heading_rad=round_rad, stepwise=True)
        free_m = around.free_m(ahead=True)
        if free_m > 0.0:
            return replace(intent, stepwise=intent.stepwise or free_m <= self._chassis.lookahead)
        to_turn_rad = intent.heading_rad - now.underway_rad
        if abs(to_turn_rad) < self._taught.turn_rad / 2.0:
            return self._wait(now)
        return replace(intent, motion=self._chassis.turn(math.copysign(1.0, to_turn_rad)))

    def _round_rad(self, heading_rad: float, belief: Belief, around: Surroundings) -> float | None:
        taught = self._taught
        way = self._mission.route.way_ahead(belief, self._chassis.lookahead, around.reach_m)
        step_m = self._chassis.speed * taught.tick_s
        turns = Turns(taught.turn_rad, step_m, taught.correlation_length)
        round_rad = detour_turn(around, way, turns, heading_rad, self._evades)
        self._evades = round_rad != heading_rad
        return round_rad

    def _before_unexpected_ground(self, intent: Intent, now: Situation) -> Intent:
        """Slow down and stop before unexpected ground, except on the way to a visible target."""
        ahead = intent.kind != "search" if intent.motion is None else intent.motion[0] > 0.0
        target_visible = now.target is not None and now.target.probability > self._config.likely
        if not ahead or target_visible:
            return intent
        if now.unexpected_ground < self._config.stops_s * self._chassis.speed:
            # The robot first turns to its way and checks the ground there.
            spacing_rad = math.radians(self._taught.config.spacing_deg)
            aside = abs(intent.heading_rad) > spacing_rad and not self._chassis.car
            return replace(intent, pace=0.0) if aside else self._wait(now)
        near = now.unexpected_ground < self._config.slows_s * self._chassis.speed
        return replace(intent, pace=self._config.slowly) if near else intent

    def _wait(self, now: Situation) -> Intent:
        """Keep a moving obstacle in view; later make room."""
        around = self._things(now)
        aside_rad = around.moving_rad if around else 0.0
        motion = STANDS
        if abs(aside_rad) > self._taught.field_rad / 4.0:
            motion = self._chassis.turn(math.copysign(1.0, aside_rad))
        elif self._periods and around and around.crowded and around.free_m(ahead=False) > 0.0:
            motion = -1.0, 0.0
        return Intent("blocked", motion, now.heading_rad)

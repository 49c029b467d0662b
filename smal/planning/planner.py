"""The planner: a belief becomes a motion.

A `Route` tells where each particle aims. The first of the `behaviours` that wants something decides, and `Steering`
makes a motion of that.
"""

import math
from dataclasses import dataclass

import numpy as np

from smal.filter import Belief
from smal.map import VisualMap
from smal.movement import Motion
from smal.obstacles.clearance import Surroundings
from smal.planning.behaviours import (
    Behaviour,
    Blind,
    DeadEnd,
    Done,
    Follow,
    Guess,
    LookAround,
    Mission,
    Said,
    Search,
    Situation,
    Wait,
)
from smal.planning.config import PLANNER_CONFIG, PlannerConfig
from smal.planning.cost_to_go import chosen_goal
from smal.planning.route import Route
from smal.planning.steering import Chassis, Kind, Steering
from smal.sought.witness import Glimpse


@dataclass(frozen=True)
class Decision:
    """What to do until the next frame, and why.

    Attributes
    ----------
    kind
        "follow": drive along the taught way; "look_around": turn, since directions disagree; "guess": drive all the
        same, since looking has not helped; "dead_end": stand, since no taught way leads on to the goal; "blocked":
        wait, since something stands in the way and nothing leads round it; "search": it has arrived, and turns to see
        what is sought, or goes up to it; "goal": stand, having said that it is found, or not here; "blind": stand,
        since no view has spoken for the robot's place for too long.
    heading_rad
        Direction to drive in, from the robot's heading, positive to the left.
    motion
        Linear velocity, ahead, and angular velocity, to the left, as shares of the robot's own, -1 to 1.
    """

    kind: Kind
    heading_rad: float
    motion: Motion


class Planner:
    """Decides for a robot that was sent to a goal.

    Parameters
    ----------
    visual_map
        What was taught.
    goal
        Where to go; it may be left out where all drives lead to one (`chosen_goal`).
    config
        The planner's numbers.
    """

    def __init__(
        self, visual_map: VisualMap, goal: str | None = None, config: PlannerConfig = PLANNER_CONFIG
    ) -> None:
        self._taught = visual_map
        self._config = config
        self._chassis = Chassis.of(visual_map, config)
        self._steering = Steering(self._chassis, visual_map.tick_s)
        self._route = Route.plan(visual_map, chosen_goal(visual_map.goals, goal), config.go_over_s)
        self.reset()

    def reset(self) -> None:
        """Forget what was being done, for a new episode."""
        self._steering.reset()
        self._doing: Kind | None = None
        self._mission = Mission(self._route)
        look = LookAround(self._taught, self._chassis)
        self._search = Search(self._taught, self._chassis, self._mission, look)
        self._wait = Wait(self._taught, self._chassis, self._mission, look)
        follow = Follow(look, self._wait)
        self._behaviours: tuple[Behaviour, ...] = (
            Done(self._mission), self._search, Blind(look), follow, look, Guess(), DeadEnd(self._mission)
        )  # fmt: skip

    @property
    def arrived(self) -> bool:
        """Whether the robot takes itself to be where it was taught that the goal is."""
        return self._search.arrived

    @property
    def said(self) -> Said | None:
        """What the robot says of its goal, having nothing left to do."""
        return self._mission.said

    @property
    def route(self) -> Route:
        """The route that it follows."""
        return self._mission.route

    def decide(
        self,
        belief: Belief,
        elapsed_s: float | None = None,
        delay_s: float = 0.0,
        seen: Glimpse | None = None,
        around: Surroundings | None = None,
        strange: float = math.inf,
    ) -> Decision:
        """Decide what to do until the next frame.

        Parameters
        ----------
        belief
            Where the robot may be.
        elapsed_s
            Time since the frame before, seconds; a taught tick if not given.
        delay_s
            Time from the frame until the decision moves the robot, which until then goes on as before, seconds.
        seen
            Whether what is sought is in view; None where nothing can tell: the robot then says that it has found it
            where it has arrived.
        around
            What stands about the robot. With odometry, a robot that turns on the spot goes round it. A thing that has
            just come is not what is sought, for every robot.
        strange
            How far ahead the ground looks like none of the taught ground, in the map's unit. A robot that does not go
            round things slows down and waits before it.
        """
        taught = self._taught
        # A robot without decisions stands after a while: it has not gone on turning since.
        elapsed_s = min(
            taught.tick_s if elapsed_s is None else elapsed_s, self._config.stands_after_s
        )
        delay_s = min(delay_s, self._config.stands_after_s)
        now = self._situation(belief, elapsed_s, delay_s, seen, around, strange)
        for behaviour in self._behaviours:
            behaviour.note(now)
        self._wait.note(now)
        proposals = (behaviour.propose(now) for behaviour in self._behaviours)
        intent = self._wait.instead_of(next(one for one in proposals if one is not None), now)
        self._doing = intent.kind
        return Decision(
            intent.kind, intent.heading_rad, self._steering.steer(intent, elapsed_s, delay_s)
        )

    def _situation(
        self,
        belief: Belief,
        elapsed_s: float,
        delay_s: float,
        seen: Glimpse | None,
        around: Surroundings | None,
        strange: float,
    ) -> Situation:
        taught = self._taught
        route = self._mission.route
        directions, left_to_go, to_end = route.aims(belief, self._chassis.lookahead)
        # Places from which no way leads to the goal have no say.
        weights = belief.weights * route.leads_on(belief)
        mean = complex((weights * np.exp(1j * directions)).sum()) / max(float(weights.sum()), 1e-12)
        leads = route.leads[belief.keyframes]
        # Beside or beyond the end by more than views change over, it is not at it.
        at_end = (
            leads
            & (to_end < taught.correlation_length)
            & (left_to_go < 0.5 * taught.speed * taught.tick_s)
        )
        has_way = route.has_way(belief)
        return Situation(
            belief=belief,
            seen=seen,
            around=around,
            strange=strange,
            elapsed_s=elapsed_s,
            doing=self._doing,
            motion=self._steering.motion,
            directions=directions,
            weights=weights + 1e-9,
            heading_rad=math.atan2(mean.imag, mean.real),
            underway_rad=self._steering.underway_rad(delay_s),
            has_way=has_way,
            clear=has_way
            and belief.lost <= 0.5
            and abs(mean) >= math.cos(math.radians(self._config.wide_deg)),
            at_goal=float(belief.weights @ (leads & (to_end < self._config.goal_s * taught.speed))),
            at_end=float(belief.weights @ at_end) > 0.5,
            unseen=belief.unseen > self._config.blind_s * taught.speed,
        )

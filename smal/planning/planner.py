"""The planner: from a belief to a motion.

A `Route` computes the aim of each particle. The first of the `behaviours` with a proposal decides, and `Steering`
turns the proposal into a motion.
"""

import math
from dataclasses import dataclass

import numpy as np

from smal.filter import Belief
from smal.map import VisualMap
from smal.movement import Motion
from smal.obstacles.clearance import Surroundings
from smal.planning.behaviours import (
    BackOff,
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
from smal.planning.route import Route
from smal.planning.steering import Chassis, Kind, Steering
from smal.target.detector import TargetEstimate


@dataclass(frozen=True)
class Decision:
    """A motion until the next frame, and its reason.

    Attributes
    ----------
    kind
        "follow": drive along the taught way. "look_around": turn to find the place, because
        directions disagree, no view supports the place, the robot is at the end of the way, or
        obstacles stop it. "guess": drive in the most probable direction, because looking around has
        not helped.
        "dead_end": stand, because no taught way leads on to the goal. "blocked": wait before an
        obstacle, turn to keep it in view, or back off; also back off after an obstacle stopped it.
        "search": at the end of the way, turn to find the target, or approach it. "goal": stand
        after announcing the result. "blind": stand, because no view has supported the robot's place
        for too long.
    heading_rad
        Direction to drive in, from the robot's heading, positive to the left.
    motion
        Linear velocity ahead and angular velocity to the left, as shares of the robot's own, -1 to 1.
    """

    kind: Kind
    heading_rad: float
    motion: Motion


class Planner:
    """Decides for a robot with a goal.

    Parameters
    ----------
    visual_map
        The taught map.
    goal
        Goal of the robot. It can be omitted if all drives lead to the same goal (`VisualMap.chosen_goal`).
    config
        Parameters of the planner.
    """

    def __init__(
        self, visual_map: VisualMap, goal: str | None = None, config: PlannerConfig = PLANNER_CONFIG
    ) -> None:
        self._taught = visual_map
        self._config = config
        self._chassis = Chassis.of(visual_map, config)
        self._steering = Steering(self._chassis, visual_map.tick_s)
        self._route = Route.plan(visual_map, visual_map.chosen_goal(goal), config.go_over_s)
        self.reset()

    def reset(self) -> None:
        """Start a new episode."""
        self._steering.reset()
        self._doing: Kind | None = None
        self._mission = Mission(self._route)
        look = LookAround(self._taught, self._chassis)
        back_off = BackOff(self._chassis, look)
        self._search = Search(self._taught, self._chassis, self._mission, look, back_off)
        wait = Wait(self._taught, self._chassis, self._mission, look)
        follow = Follow(look, wait)
        self._behaviours: tuple[Behaviour, ...] = (
            Done(self._mission),
            self._search,
            Blind(self._chassis, look),
            back_off,
            follow,
            look,
            Guess(self._chassis),
            DeadEnd(),
            wait,
        )

    @property
    def arrived(self) -> bool:
        """Whether the robot estimates to be at the taught goal."""
        return self._search.arrived

    @property
    def radius_m(self) -> float:
        """Radius of a robot with odometry whose mount is unknown, metres."""
        return self._chassis.radius

    @property
    def said(self) -> Said | None:
        """Announced result of the search; None while the robot is under way."""
        return self._mission.said

    def decide(
        self,
        belief: Belief,
        elapsed_s: float | None = None,
        delay_s: float = 0.0,
        target: TargetEstimate | None = None,
        around: Surroundings | None = None,
        unexpected_ground: float = math.inf,
        *,
        held_back: bool = False,
    ) -> Decision:
        """Decide the motion until the next frame.

        Parameters
        ----------
        belief
            Estimated place of the robot.
        elapsed_s
            Time since the frame before, seconds; by default a taught tick.
        delay_s
            Latency from the frame until the decision moves the robot, seconds. Until then the last motion goes on.
        target
            Probability that the target is in view; None without a target detector. The robot then announces "found"
            on arrival by a tracked way.
        around
            Obstacles around a robot with odometry, which adds what it touches. A robot that turns on the spot drives
            around them. For every robot, an obstacle that has just appeared is not the target.
        unexpected_ground
            Distance to unexpected ground ahead, in the map's unit. A robot without a depth camera, or that does not
            drive around obstacles, slows down and waits before it.
        held_back
            Whether the actuator has stopped the last motion before an obstacle.
        """
        if elapsed_s is None:
            elapsed_s = self._taught.tick_s
        # Without decisions the robot stops after a while: it has not gone on turning since.
        elapsed_s = min(elapsed_s, self._config.stands_after_s)
        delay_s = min(delay_s, self._config.stands_after_s)
        held = self._held(belief, elapsed_s, held_back=held_back)
        now = self._situation(belief, elapsed_s, delay_s, target, around, unexpected_ground, held)
        for behaviour in self._behaviours:
            behaviour.note(now)
        self._mission.said = self._mission.said or self._search.judge(now)
        proposals = (behaviour.propose(now) for behaviour in self._behaviours)
        intent = next(intent for intent in proposals if intent is not None)
        for behaviour in self._behaviours:
            intent = behaviour.instead_of(intent, now)
        self._doing = intent.kind
        motion = self._steering.steer(intent, elapsed_s, delay_s)
        return Decision(intent.kind, intent.heading_rad, motion)

    def _held(self, belief: Belief, elapsed_s: float, *, held_back: bool) -> bool | None:
        """Return whether an obstacle stopped the last motion ahead, by the actuator or by the wheels."""
        commanded = self._chassis.speed * self._steering.motion[0] * elapsed_s
        if commanded <= 0.0:
            return None
        if held_back:
            return True
        return None if belief.moved is None else belief.moved < 0.1 * commanded

    def _situation(
        self,
        belief: Belief,
        elapsed_s: float,
        delay_s: float,
        target: TargetEstimate | None,
        around: Surroundings | None,
        unexpected_ground: float,
        held: bool | None,
    ) -> Situation:
        taught = self._taught
        route = self._mission.route
        directions, left_to_go, to_end = route.aims(belief, self._chassis.lookahead)
        # Places without a way to the goal have no weight.
        weights = belief.weights * route.leads_on(belief)
        total = max(float(weights.sum()), 1e-12)
        mean = complex((weights * np.exp(1j * directions)).sum()) / total
        agree = abs(mean) >= math.cos(math.radians(self._config.wide_deg))
        leads = route.leads[belief.keyframes]
        near_goal = leads & (to_end < self._config.goal_s * taught.speed)
        # Beside or beyond the end by more than a correlation length, the robot is not at the end.
        beside_end = to_end < taught.correlation_length
        at_end = leads & beside_end & (left_to_go < 0.5 * taught.speed * taught.tick_s)
        has_way = route.has_way(belief)
        return Situation(
            belief=belief,
            target=target,
            around=around,
            unexpected_ground=unexpected_ground,
            elapsed_s=elapsed_s,
            doing=self._doing,
            motion=self._steering.motion,
            turned_rad=self._steering.motion[1] * self._chassis.turn_rad_s * elapsed_s,
            directions=directions,
            weights=weights,
            heading_rad=math.atan2(mean.imag, mean.real),
            underway_rad=self._steering.underway_rad(delay_s),
            has_way=has_way,
            clear=has_way and not belief.is_lost and agree,
            at_goal=float(belief.weights @ near_goal),
            at_end=float(belief.weights @ at_end) > 0.5,
            unseen=belief.unseen > self._config.blind_s * taught.speed,
            supported=belief.support >= math.log(self._config.decisive),
            held=held,
        )

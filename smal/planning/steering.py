"""Steering: an intent becomes a velocity.

A robot that drives freely takes the velocity after which, expected over its belief, least is left to go (QMDP; Littman,
Cassandra and Kaelbling 1995). Each velocity is rolled out, after what the last one does until this one begins: an arc.
What is left from the arc's end to the aim of each likely place is the way there, and the turn towards it. Where things
are near, the robot turns on the spot and then drives straight, so that it sweeps no ground beside its way.
"""

import math
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from smal.map import VisualMap
from smal.movement import STANDS, Motion, placed, seen_from, turns_ahead
from smal.planning.config import PlannerConfig

Floats = NDArray[np.float64]
Kind = Literal["follow", "look_around", "guess", "dead_end", "blocked", "goal", "search", "blind"]


@dataclass(frozen=True)
class Intent:
    """What a behaviour wants the robot to do until the next frame.

    Attributes
    ----------
    kind
        Name of the behaviour, as in `smal.planning.Decision`.
    motion
        The motion to make; None to drive.
    heading_rad
        Direction to drive in, from the robot's heading, positive to the left.
    directions, weights
        Direction (p,) to each particle's aim, and the weight of that particle (p,).
    stepwise
        Whether to turn on the spot to the heading, and then drive straight.
    pace
        Share of the speed at most.
    """

    kind: Kind
    motion: Motion | None = None
    heading_rad: float = 0.0
    directions: Floats | None = None
    weights: Floats | None = None
    stepwise: bool = False
    pace: float = 1.0


class Chassis(NamedTuple):
    """How a robot moves: ways in the map's unit a second, and radians a second; a car does not turn on the spot."""

    speed: float
    turn_rad_s: float
    car: bool
    config: PlannerConfig

    @classmethod
    def of(cls, taught: VisualMap, config: PlannerConfig) -> "Chassis":
        """Return the chassis with which a map was taught."""
        return cls(
            taught.speed, taught.turn_rad / taught.tick_s, turns_ahead(taught.movements), config
        )

    @property
    def lookahead(self) -> float:
        """How far ahead on the taught way it aims, in the map's unit."""
        return self.config.lookahead_s * self.speed

    def arc(self, linear: Floats | float, angular: Floats | float, time_s: float) -> Floats:
        """Return where velocities (v,) lead in a time: ahead, left, turned (v, 3)."""
        turned = np.asarray(angular) * self.turn_rad_s * time_s
        chord = linear * self.speed * time_s * np.sinc(turned / 2.0 / np.pi)
        return np.stack(
            [chord * np.cos(turned / 2.0), chord * np.sin(turned / 2.0), turned], axis=-1
        )

    def turn(self, side: float) -> Motion:
        """Return the motion that turns to a side, 1 for left and -1 for right; a car drives slowly in a bend."""
        return (self.config.look_speed, self.config.look_speed * side) if self.car else (0.0, side)

    def best(self, directions: Floats, weights: Floats, last: Motion, delay_s: float) -> Motion:
        """Return the motion that leaves least to go for particles that aim in directions (p,), by their weights (p,).

        The aims lie ahead of where the robot is when this motion begins, also beyond the end of the way: nearer aims
        would make full speed lead too far.
        """
        away = self.speed * (self.config.lookahead_s + delay_s * abs(last[0]))
        aims = np.stack([away * np.cos(directions), away * np.sin(directions)], axis=1)
        shares = np.meshgrid(np.linspace(0.0, 1.0, 5), np.linspace(-1.0, 1.0, 41))
        linear, angular = (share.ravel() for share in shares)
        # A robot that stands sees nothing new.
        can = (
            (linear > 0.0) & (np.abs(angular) <= linear)
            if self.car
            else linear + np.abs(angular) >= 0.25
        )
        linear = linear[can]
        angular = angular[can]
        ends = placed(self.arc(linear, angular, self.config.lookahead_s), self.arc(*last, delay_s))
        x, y, _ = np.moveaxis(seen_from(np.pad(aims, ((0, 0), (0, 1))), ends[:, None]), -1, 0)
        left_s = np.hypot(x, y) / self.speed
        # Near its aim a robot need not turn to it any more.
        turn_s = (
            np.abs(np.arctan2(y, x))
            / self.turn_rad_s
            * np.minimum(left_s / (self.config.lookahead_s / 2.0), 1.0)
        )
        cost_s = (left_s + turn_s) @ weights / weights.sum() + self.config.restless_s * np.abs(
            angular - last[1]
        )
        best = int(cost_s.argmin())
        return float(linear[best]), float(angular[best])


class Steering:
    """Turns intents into motions.

    Parameters
    ----------
    chassis
        How the robot moves.
    tick_s
        The taught tick, seconds.
    """

    def __init__(self, chassis: Chassis, tick_s: float) -> None:
        self._chassis = chassis
        self._turn_rad = chassis.turn_rad_s * tick_s
        self._tick_s = tick_s
        self.reset()

    def reset(self) -> None:
        """Forget the last motion, for a new episode."""
        self.motion = STANDS  # The last one.

    def underway_rad(self, delay_s: float) -> float:
        """Return how far the robot still turns by its last motion before the next one begins."""
        return self._turn_rad * min(delay_s / self._tick_s, 1.0) * self.motion[1]

    def steer(self, intent: Intent, elapsed_s: float, delay_s: float) -> Motion:
        """Return the motion for an intent, and take it as the last one."""
        linear, angular = self._motion(intent, elapsed_s, delay_s)
        # At pace 0 the robot only turns.
        self.motion = intent.pace * linear, (intent.pace or 1.0) * angular
        return self.motion

    def _motion(self, intent: Intent, elapsed_s: float, delay_s: float) -> Motion:
        if intent.motion is not None:
            return intent.motion
        if (
            intent.stepwise
            or intent.directions is None
            or intent.weights is None
            or self._chassis.speed <= 0.0
        ):
            return self._step(intent.heading_rad - self.underway_rad(delay_s), elapsed_s)
        return self._chassis.best(intent.directions, intent.weights, self.motion, delay_s)

    def _step(self, to_turn_rad: float, elapsed_s: float) -> Motion:
        """Begin to turn where the heading is off by more than a tick's turn, go on until half of one; else drive on."""
        side = math.copysign(1.0, to_turn_rad)
        turns = self.motion[0] <= 0.0 and self.motion[1] * side > 0.0
        # At a low rate a turn until the next frame is longer: it must not lead further to the other side.
        least = max(0.5 if turns else 1.0, 0.5 * elapsed_s / self._tick_s)
        return self._chassis.turn(side) if abs(to_turn_rad) > self._turn_rad * least else (1.0, 0.0)

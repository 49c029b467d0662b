"""Steering: from an intent to a velocity.

A robot in free space takes the velocity with the least expected cost over its belief (QMDP; Littman, Cassandra and
Kaelbling 1995). Each candidate is rolled out to an arc, after the motion that is still under way. The cost of an arc is
the time from its end to the aim of each particle, and the turn towards the aim. Near obstacles the robot turns on the
spot and then drives straight, so that it stays on its way.
"""

import math
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from smal.arrays import Floats
from smal.map import VisualMap
from smal.movement import STANDS, Motion, placed, seen_from, turns_ahead
from smal.planning.config import PlannerConfig

Kind = Literal["follow", "look_around", "guess", "dead_end", "blocked", "goal", "search", "blind"]


@dataclass(frozen=True)
class Intent:
    """Proposal of a behaviour until the next frame.

    Attributes
    ----------
    kind
        Reported kind, as in `smal.planning.Decision`.
    motion
        Motion to execute; None to drive.
    heading_rad
        Direction to drive in, from the robot's heading, positive to the left.
    directions, weights
        Direction (p,) to each particle's aim, and the weight of that particle (p,).
    stepwise
        Whether to turn on the spot to the heading, and then drive straight.
    pace
        Maximum share of the speed.
    """

    kind: Kind
    motion: Motion | None = None
    heading_rad: float = 0.0
    directions: Floats | None = None
    weights: Floats | None = None
    stepwise: bool = False
    pace: float = 1.0


class Chassis(NamedTuple):
    """Kinematics of a robot, in the map's unit, radians and seconds; a car cannot turn on the spot."""

    speed: float
    turn_rad_s: float
    car: bool
    config: PlannerConfig

    @classmethod
    def of(cls, taught: VisualMap, config: PlannerConfig) -> "Chassis":
        """Return the chassis of the robot that was taught."""
        turn_rad_s = taught.turn_rad / taught.tick_s
        return cls(taught.speed, turn_rad_s, turns_ahead(taught.movements), config)

    @property
    def lookahead(self) -> float:
        """Distance to the aim on the taught way, in the map's unit."""
        return self.config.lookahead_s * self.speed

    @property
    def radius(self) -> float:
        """Radius of a robot without a mount, in the map's unit."""
        return self.config.radius_s * self.speed

    def arc(self, linear: Floats | float, angular: Floats | float, time_s: float) -> Floats:
        """Return the pose after velocities (v,) for a time: ahead, left, turned (v, 3)."""
        turned = np.asarray(angular) * self.turn_rad_s * time_s
        chord = linear * self.speed * time_s * np.sinc(turned / 2.0 / np.pi)
        ahead = chord * np.cos(turned / 2.0)
        left = chord * np.sin(turned / 2.0)
        return np.stack([ahead, left, turned], axis=-1)

    def turn(self, side: float) -> Motion:
        """Return the motion that turns to a side, 1 for left and -1 for right; a car drives slowly in a bend."""
        if self.car:
            return self.config.look_speed, self.config.look_speed * side
        return 0.0, side

    def best(self, directions: Floats, weights: Floats, last: Motion, delay_s: float) -> Motion:
        """Return the motion with the least expected cost for particles with directions (p,) and weights (p,).

        The aims lie ahead of the robot's pose at the start of this motion, also beyond the end of the way. With nearer
        aims, full speed leads too far. If all weights are 0, all directions count alike.
        """
        weights = weights + 1e-9
        lookahead_s = self.config.lookahead_s
        away = self.speed * (lookahead_s + delay_s * abs(last[0]))
        aims = np.stack(
            [away * np.cos(directions), away * np.sin(directions), np.zeros_like(directions)],
            axis=1,
        )
        linear, angular = self._candidates()
        ends = placed(self.arc(linear, angular, lookahead_s), self.arc(*last, delay_s))
        x, y, _ = np.moveaxis(seen_from(aims, ends[:, None]), -1, 0)
        left_s = np.hypot(x, y) / self.speed
        # Near the aim the turn counts less.
        share = np.minimum(left_s / (lookahead_s / 2.0), 1.0)
        turn_s = np.abs(np.arctan2(y, x)) / self.turn_rad_s * share
        expected_s = (left_s + turn_s) @ weights / weights.sum()
        restless_s = self.config.restless_s * np.abs(angular - last[1])
        best = int((expected_s + restless_s).argmin())
        return float(linear[best]), float(angular[best])

    def _candidates(self) -> tuple[Floats, Floats]:
        """Return the linear and the angular velocities to choose from, as shares."""
        shares = np.meshgrid(np.linspace(0.0, 1.0, 5), np.linspace(-1.0, 1.0, 41))
        linear, angular = (share.ravel() for share in shares)
        # A robot that stands gets no new views.
        moves = linear + np.abs(angular) >= 0.25
        if self.car:
            moves = (linear > 0.0) & (np.abs(angular) <= linear)
        return linear[moves], angular[moves]


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
        """Start a new episode."""
        #: The last motion.
        self.motion = STANDS

    def underway_rad(self, delay_s: float) -> float:
        """Return the remaining turn by the last motion until the next motion begins."""
        return self._turn_rad * min(delay_s / self._tick_s, 1.0) * self.motion[1]

    def steer(self, intent: Intent, elapsed_s: float, delay_s: float) -> Motion:
        """Return the motion for an intent, and store it as the last motion."""
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
        """Turn on the spot while the heading is off, with a hysteresis of half a tick's turn; otherwise drive on."""
        side = math.copysign(1.0, to_turn_rad)
        turns = self.motion[0] <= 0.0 and self.motion[1] * side > 0.0
        # At a low frame rate the turn until the next frame is longer. It must not overshoot to the other side.
        least = max(0.5 if turns else 1.0, 0.5 * elapsed_s / self._tick_s)
        if abs(to_turn_rad) > self._turn_rad * least:
            return self._chassis.turn(side)
        return 1.0, 0.0

"""Detect wheels that do not follow their commands, by comparison with the odometry."""

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import astuple
from typing import Final

from schemas.base import STANDING, TICK_S, Velocity
from services.robot.body import Kinematics
from smal.movement import Movement

#: Delay of a base until it begins to follow a command, and time until it then has its full speed,
#: seconds. Both are from slow bases; a faster base moves more than is expected of it.
DELAY_S: Final = 0.2
STARTS_S: Final = 1.0
#: Commanded but missing distance that counts as a fault, as time at full speed, seconds. Less is
#: noise of the odometry. With the distance before a command is expected to show, the base stands
#: within a second of driving.
UNFOLLOWED_S: Final = 0.25
# Share of the expected distance that counts as following, for loads, slopes and worn tyres.
LAG: Final = 0.5
#: Share of the full turn rate below which no turn is expected: a skid-steered base slips in gentle
#: bends.
SLIPS: Final = 0.5
#: Frames without odometry after which the comparison restarts. The body detects its silence.
SILENT_FRAMES: Final = 3
_STEP_S: Final = 0.02  # Time step of the expected movement, seconds.


class WheelCheck:
    """Compares the commands of a base with its odometry; one thread calls ``told``, one ``read``.

    Excess movement is not detected. Readings arrive every ``frame_s`` seconds.
    """

    def __init__(self, kinematics: Kinematics, frame_s: float = TICK_S) -> None:
        self._silent_s = SILENT_FRAMES * frame_s + _STEP_S
        self._axes = (
            _Axis("m", kinematics.speed_m_s, "speed", 0.0),
            _Axis("rad", kinematics.turn_rate_rad_s, "turn rate", SLIPS),
        )
        self._told = deque[tuple[float, Velocity]]([(-math.inf, STANDING)])
        self._read: tuple[float, Sequence[float]] | None = None

    def told(self, velocity: Velocity, now_s: float) -> None:
        """Store the velocity that the base executes from now on."""
        if velocity == self._told[-1][1]:
            return
        self._told.append((now_s, velocity))
        while len(self._told) > 1 and self._told[1][0] < now_s - self._silent_s - DELAY_S:
            self._told.popleft()

    def read(self, pose: Sequence[float], at_s: float) -> str | None:
        """Take an odometry pose; return how it contradicts the commands, in one line, or None."""
        if not all(map(math.isfinite, pose)):
            return f"the odometry is not finite: {tuple(pose)}"
        if self._read is not None and at_s <= self._read[0]:
            return None
        before = self._read
        self._read = (at_s, tuple(pose))
        if before is None or at_s - before[0] > self._silent_s:
            for axis in self._axes:
                axis.restart()
            return None
        self._expect(before[0], at_s)
        reported = Movement.between(before[1], pose)
        found = [
            axis.compare(moved, at_s - before[0])
            for axis, moved in zip(self._axes, astuple(reported), strict=True)
        ]
        return next((one for one in found if one is not None), None)

    def _expect(self, since_s: float, until_s: float) -> None:
        """Add the minimum expected movement to each axis."""
        orders = [*self._told]  # Another thread can append meanwhile.
        steps = max(1, round((until_s - since_s) / _STEP_S))
        step_s = (until_s - since_s) / steps
        for number in range(steps):
            at_s = since_s + (number + 1) * step_s
            order = _order(orders, at_s)
            late = _order(orders, at_s - DELAY_S)
            for which, axis in enumerate(self._axes):
                axis.step(order[which], late[which], step_s)


def _order(orders: Sequence[tuple[float, Velocity]], at_s: float) -> Velocity:
    """Return the last command at a time."""
    return next((told for told_s, told in reversed(orders) if told_s <= at_s), STANDING)


class _Axis:
    """One axis, forward or turning: the minimum expected movement, and the missing odometry.

    A base can stop at once, or late, and accelerates slowly. The sum of the missing movement is
    kept (a cumulative sum test, Page 1954). Odometry that stands and odometry that runs backwards
    both exceed the bound. Shares of the full speed below the minimum are not expected to show.
    """

    def __init__(self, unit: str, full: float, name: str, least: float) -> None:
        self._unit = unit
        self._full = full
        self._name = name
        self._least = least
        self._direction = 1.0  # Sign of the last expected movement.
        self.restart()

    def restart(self) -> None:
        """Reset the expectation, as for a base that stands."""
        self._quick = 0.0  # Share of the full speed if the base slows down at once,
        self._slow = 0.0  # and if it slows down as slowly as it accelerates.
        self._expected_s = 0.0  # Time at full speed that is expected since the last reading.
        self._lacks_s = 0.0  # Time at full speed that the odometry lacks.

    def step(self, order: float, late: float, step_s: float) -> None:
        """Advance the time with the current command and the delayed command that the base obeys."""
        most = step_s / STARTS_S
        self._slow += max(-most, min(late - self._slow, most))
        self._quick = (
            math.copysign(min(abs(late), abs(self._quick) + most), late)
            if self._quick * late >= 0
            else 0.0
        )
        if order * self._quick > 0.0 and order * self._slow > 0.0:
            share = min(abs(order), abs(self._quick), abs(self._slow))
            if share >= self._least:
                self._direction = math.copysign(1.0, order)
                self._expected_s += share * step_s

    def compare(self, moved: float, elapsed_s: float) -> str | None:
        """Take a reported movement; return how it contradicts the expectation, or None."""
        expected_s = self._expected_s
        self._expected_s = 0.0
        followed_s = self._direction * moved / self._full / LAG
        if expected_s == 0.0:
            followed_s = max(followed_s, 0.0)  # Rolling on after a command pays off no deficit.
        self._lacks_s = max(self._lacks_s + expected_s - followed_s, 0.0)
        if self._lacks_s <= UNFOLLOWED_S:
            return None
        self._lacks_s = 0.0
        least = self._direction * expected_s * self._full * LAG
        return (
            f"the odometry does not follow the commands: {moved:.2f} {self._unit} "
            f"in {elapsed_s:.1f} s, at least {least:.2f} {self._unit} expected "
            f"at a {self._name} of {self._full:g} {self._unit}/s"
        )

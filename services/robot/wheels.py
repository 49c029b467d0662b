"""Whether the wheels do what they are told: the commands that were carried out against the odometry."""

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import astuple
from typing import Final

from schemas.base import STANDING, Velocity
from services.robot.body import Kinematics
from services.robot.clock import TICK_S
from smal.movement import Movement

#: Time until a base begins to follow a command, and until it has its full speed then, seconds. Both are those of slow
#: bases: a base that is faster does more than is expected of it.
DELAY_S: Final = 0.2
STARTS_S: Final = 1.0
#: Way that may be commanded without being driven, in time at full speed, seconds. Less is noise of the odometry; with
#: what a base drives before a command is expected to show, it stands within a second of driving.
UNFOLLOWED_S: Final = 0.25
LAG: Final = 0.5  # Share of the expected way at which the wheels follow: loads, slopes and worn tyres take some.
#: Share of the full turn rate below which no turn is expected: a skid-steered base slips in gentle bends.
SLIPS: Final = 0.5
#: Frames without odometry after which it is compared anew. Its silence is no contradiction: the body notices that.
SILENT_FRAMES: Final = 3
_STEP_S: Final = 0.02  # Time step in which the expected movement is added up, seconds.


class WheelCheck:
    """Compares what a base was told with what its odometry reports; ``told`` is called by one thread, ``read`` by one.

    A base that moves more than it was told is not noticed. Readings come every ``frame_s`` seconds.
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
        """Take what the base carries out from now on."""
        if velocity == self._told[-1][1]:
            return
        self._told.append((now_s, velocity))
        while len(self._told) > 1 and self._told[1][0] < now_s - self._silent_s - DELAY_S:
            self._told.popleft()

    def read(self, pose: Sequence[float], at_s: float) -> str | None:
        """Take a pose by the wheels; return in one line how it contradicts the commands, or None."""
        if not all(map(math.isfinite, pose)):
            return f"the odometry is not finite: {tuple(pose)}"
        if self._read is not None and at_s <= self._read[0]:
            return None  # The same reading, or an older one.
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
        """Have each axis add up what the base moved at least."""
        orders = [*self._told]  # Another thread may append meanwhile.
        steps = max(1, round((until_s - since_s) / _STEP_S))
        step_s = (until_s - since_s) / steps
        for number in range(steps):
            at_s = since_s + (number + 1) * step_s
            order = _order(orders, at_s)
            late = _order(orders, at_s - DELAY_S)
            for which, axis in enumerate(self._axes):
                axis.step(order[which], late[which], step_s)


def _order(orders: Sequence[tuple[float, Velocity]], at_s: float) -> Velocity:
    """Return what a base was told last at a time."""
    return next((told for told_s, told in reversed(orders) if told_s <= at_s), STANDING)


class _Axis:
    """The way ahead, or the turn: what a base does at least, and how much of it the odometry lacks.

    A base may stop at once, or late, and speeds up slowly. The sum of what was expected and not reported is kept (a
    cumulative sum test, Page 1954). Odometry that stands and odometry that runs backwards both exceed the bound.
    Shares of the full speed below the least one are not expected to show.
    """

    def __init__(self, unit: str, full: float, name: str, least: float) -> None:
        self._unit = unit
        self._full = full
        self._name = name
        self._least = least
        self._direction = 1.0  # Sign of the last expected movement.
        self.restart()

    def restart(self) -> None:
        """Forget what was expected, as of a base that stands."""
        self._quick = 0.0  # Share of the full speed if the base slows down at once,
        self._slow = 0.0  # and if it slows down as slowly as it speeds up.
        self._expected_s = 0.0  # Time at full speed that is expected since the last reading.
        self._lacks_s = 0.0  # Time at full speed that the odometry lacks.

    def step(self, order: float, late: float, step_s: float) -> None:
        """Let time pass in which a base is given an order, and obeys a late one."""
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
        """Take a reported movement; return how it contradicts what was expected, or None."""
        expected_s = self._expected_s
        self._expected_s = 0.0
        followed_s = self._direction * moved / self._full / LAG
        if expected_s == 0.0:
            followed_s = max(
                followed_s, 0.0
            )  # A base that rolls on after its order does what it owes.
        self._lacks_s = max(self._lacks_s + expected_s - followed_s, 0.0)
        if self._lacks_s <= UNFOLLOWED_S:
            return None
        self._lacks_s = 0.0
        least = self._direction * expected_s * self._full * LAG
        return (
            f"the odometry does not follow the commands: {moved:.2f} {self._unit} in {elapsed_s:.1f} s, at least "
            f"{least:.2f} {self._unit} expected at a {self._name} of {self._full:g} {self._unit}/s"
        )

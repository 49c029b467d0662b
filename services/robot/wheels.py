"""Whether the wheels do what they are told: the commands that were carried out against the odometry."""

import math
from collections import deque
from collections.abc import Sequence
from typing import Final

from schemas.base import STANDING, Velocity
from services.robot.body import Kinematics
from smal.movement import Movement

#: Time until a base begins to follow a command, and until it has its full speed then, seconds. Both are those of slow
#: bases: a base that is faster does more than is expected of it.
DELAY_S: Final = 0.2
STARTS_S: Final = 1.0
#: Way that may be commanded without being driven, in time at full speed, seconds. Less is noise of the odometry; with
#: what a base drives before a command is expected to show, it stands within a second of driving.
UNFOLLOWED_S: Final = 0.25
LAG: Final = 0.5  # Share of the expected way at which the wheels follow: loads, slopes and worn tyres take some.
_KEPT_S: Final = 2.0  # Orders that are kept; odometry that comes more seldom is compared over this time alone.
_STEP_S: Final = 0.02  # Time step in which the expected movement is added up, seconds.


class Wheels:
    """Compares what a base was told with what its odometry reports; ``told`` is called by one thread, ``read`` by one.

    The sum of what was expected and not reported is kept for the way ahead and for the turn (a cumulative sum test,
    Page 1954). A wheel that stands and a wheel that runs backwards both exceed the bound.
    """

    def __init__(self, kinematics: Kinematics) -> None:
        self._full = kinematics.speed_m_s, kinematics.turn_rate_rad_s
        self._told = deque[tuple[float, Velocity]]([(-math.inf, STANDING)])
        self._read: tuple[float, Sequence[float]] | None = None
        self._bases = _Base(), _Base()
        self._expected = [0.0, 0.0]  # Shares of the full speed and turn rate at which the base moves, at least.
        self._unfollowed_s = [0.0, 0.0]  # Time at full speed, and at full turn rate, that the odometry lacks.

    def told(self, velocity: Velocity, now_s: float) -> None:
        """Take what the base carries out from now on."""
        if velocity == self._told[-1][1]:
            return
        self._told.append((now_s, velocity))
        while len(self._told) > 1 and self._told[1][0] < now_s - _KEPT_S:
            self._told.popleft()

    def read(self, pose: Sequence[float], at_s: float) -> str | None:
        """Take a pose by the wheels; return in one line how it contradicts the commands, or None."""
        before, self._read = self._read, (at_s, tuple(pose))
        if before is None:
            return None
        since_s = max(before[0], at_s - _KEPT_S)
        expected_s = self._expect(since_s, at_s)
        reported = Movement.between(before[1], pose)
        found = None
        for axis, moved in enumerate((reported.ahead, reported.turn_rad)):
            followed_s = math.copysign(1.0, expected_s[axis]) * moved / self._full[axis] / LAG
            lacks_s = self._unfollowed_s[axis] + abs(expected_s[axis]) - followed_s
            self._unfollowed_s[axis] = max(lacks_s, 0.0) if expected_s[axis] else self._unfollowed_s[axis]
            if self._unfollowed_s[axis] > UNFOLLOWED_S:
                found = "the odometry does not follow the commands: " + (
                    f"{reported.ahead:.2f} m" if axis == 0 else f"{math.degrees(reported.turn_rad):.0f} degrees"
                ) + f" in {at_s - since_s:.1f} s, {self._expected[axis] * self._full[axis]:.2f} "  # fmt: skip
                found += "m/s expected" if axis == 0 else "rad/s expected"
        if found is not None:
            self._unfollowed_s = [0.0, 0.0]
        return found

    def _expect(self, since_s: float, until_s: float) -> list[float]:
        """Return how long the base moved at its full speed and turn rate, at least, with the sign of its movement."""
        orders = [*self._told]  # Another thread may append meanwhile.
        steps = max(1, round((until_s - since_s) / _STEP_S))
        step_s = (until_s - since_s) / steps
        total_s = [0.0, 0.0]
        for number in range(steps):
            at_s = since_s + (number + 1) * step_s
            order, late = _order(orders, at_s), _order(orders, at_s - DELAY_S)
            for axis, base in enumerate(self._bases):
                self._expected[axis] = base.step(order[axis], late[axis], step_s / STARTS_S)
                total_s[axis] += self._expected[axis] * step_s
        return total_s


def _order(orders: Sequence[tuple[float, Velocity]], at_s: float) -> Velocity:
    """Return what a base was told last at a time."""
    return next((told for told_s, told in reversed(orders) if told_s <= at_s), STANDING)


class _Base:
    """The least that any base does along one axis: it may stop at once, or late, and speeds up slowly."""

    def __init__(self) -> None:
        self._quick = 0.0  # Share of the full speed if it slows down at once,
        self._slow = 0.0  # and if it slows down as slowly as it speeds up.

    def step(self, order: float, late: float, most: float) -> float:
        """Return the share at which it moves, at least, where it is given an order, and obeyed a late one."""
        self._slow += max(-most, min(late - self._slow, most))
        self._quick = math.copysign(min(abs(late), abs(self._quick) + most), late) if self._quick * late >= 0 else 0.0
        least = min(abs(order), abs(self._quick), abs(self._slow))
        agree = order * self._quick > 0.0 and order * self._slow > 0.0
        return math.copysign(least, order) if agree else 0.0

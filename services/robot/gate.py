"""The last check before the wheels: the choice of the command that the actuator obeys.

All times are on the actuator's own clock. A command names the frame (tick) that it descends from,
and the gate stores when it captured that frame. Therefore an old command never becomes fresh. A
wrong or jumping clock in another process cannot make it so, nor can a process that was frozen and
wakes with old plans. A heartbeat names the pulse that it answers, and is as old as that pulse, so a
slow link cannot make an absent operator seem present.
"""

import math
import secrets
from collections import Counter
from dataclasses import dataclass, field, replace
from threading import Lock
from typing import Final, Literal

from schemas.base import STANDING, Source, Velocity
from schemas.command import Command, Limit, Reason, StopCause
from schemas.heartbeat import Heartbeat
from services.robot.body import Kinematics
from services.robot.clock import ABSENT_S, SILENCE_S
from services.robot.guard import Guard
from services.robot.wheels import WheelCheck

#: Age at which a command expires, seconds since the capture of its frame, unless the robot's
#: settings allow more. On one machine, where answers are immediate, silence thus counts from the
#: last answered frame.
MAX_AGE_S: Final = SILENCE_S
#: Silence after which another process of the same source can command, seconds; the restart of a
#: killed process takes longer.
LEASE_S: Final = 1.0
# Share of its speed at which a robot continues for a person who insists: it stops within a hand's
# width.
INSISTED: Final = 0.2
Refusal = Literal[
    "wrong episode",
    "not the driver",
    "not the operator",
    "another session",
    "not finite",
    "unknown frame",
    "stale",
    "out of order",
]
#: The last of several causes is reported: the operator needs it to arm the robot.
_WEIGHT: Final[tuple[StopCause, ...]] = (
    "not_armed",
    "operator_lost",
    "wheels",
    "fault",
    "emergency_stop",
)


@dataclass(frozen=True)
class Applied:
    """Motion of the actuator, and the frame whose command caused it."""

    velocity: Velocity
    source: Source | None
    reason: Reason
    answered_tick: int | None = None
    # Age of the command, since the capture of its frame.
    age_s: float = field(default=0.0, compare=False)


@dataclass(frozen=True)
class _Accepted:
    command: Command
    captured_s: float
    offered_s: float
    until_s: float  # Time of its expiry.

    @property
    def order(self) -> tuple[int, int]:
        return self.command.tick, self.command.sequence


@dataclass(frozen=True)
class _Operator:
    """The last operator; kept after leaving, so that an old heartbeat stays invalid."""

    session: str
    name: str
    sequence: int
    answered_s: float  # Time of the newest pulse that they have answered.
    there: bool


class CommandGate:
    """Arbitrates between the sources of commands for one robot; thread-safe.

    The gate starts with a latched stop, `not_armed`: a restarted robot moves only after it is
    armed. The first stop has a random number, so that a release from before a restart is invalid;
    ``first_stop`` sets it.

    A command expires `SILENCE_S` after its arrival, and at an age counted from the capture of its
    frame. A delayed command is obeyed for less time, or not at all; its delay never extends the
    silence. With ``attended``, the robot moves only while an operator is present.
    """

    def __init__(
        self, max_age_s: float = MAX_AGE_S, *, attended: bool = False, first_stop: int | None = None
    ) -> None:
        self.max_age_s = max_age_s
        #: Bounds the speed of every driver by the visible obstacles.
        self.guard: Guard | None = None
        self.wheels: WheelCheck | None = None  # Compares the executed commands with the odometry.
        self.kinematics = Kinematics(1.0, 1.0)
        self.attended = attended
        #: An unattended robot, as in simulation, tolerates a busy computer.
        self.absent_s = ABSENT_S if attended else LEASE_S
        self._lock = Lock()
        self._stops = first_stop or 1 + secrets.randbits(48)
        self._released = 0
        self._cause: StopCause = "not_armed"
        self._operator: _Operator | None = None
        # Random, so that an answer to a pulse from before a restart is invalid.
        self._pulse = secrets.randbits(48)
        self._pulsed_s: dict[int | None, float] = {}
        self._begin("", "policy")

    # -- stops -------------------------------------------------------------------------------------

    @property
    def latched_stop(self) -> int:
        """Number of the latched stop; 0 without a stop."""
        return self._stops if self._stops != self._released else 0

    @property
    def stop_cause(self) -> StopCause | None:
        """Cause of the latched stop."""
        return self._cause if self.latched_stop else None

    def stop(self, cause: StopCause = "emergency_stop") -> None:
        """Latch a stop; the graver of several causes is reported until the robot is armed."""
        with self._lock:
            self._latch(cause)

    def _latch(self, cause: StopCause) -> None:
        self._cause = max(self.stop_cause or cause, cause, key=_WEIGHT.index)
        self._stops += 1

    def arm(self, stop: int, session: str) -> str | None:
        """Release a stop by its number, or return why it stays.

        The number protects a later stop. Earlier commands expire, and an earlier driver continues
        only after ``resume``, or in the next episode.
        """
        with self._lock:
            refusal = self.not_theirs(session)
            if refusal is not None:
                return refusal
            if self.attended and self.operator is None:
                return "no operator answers in time; this robot moves only with a present operator"
            if not self.latched_stop or stop != self.latched_stop:
                return (
                    "another stop was latched since; arm again"
                    if self.latched_stop
                    else "no stop is latched"
                )
            self._taken_over = self._episode != ""
            self._expire()
            self._released = stop
            return None

    # -- the operator ------------------------------------------------------------------------------

    @property
    def operator(self) -> str | None:
        """Session of the present operator, if any."""
        operator = self._operator
        return operator.session if operator is not None and operator.there else None

    def pulse(self, now_s: float) -> int:
        """Return the number of the pulse that is sent now, and forget pulses too old to answer."""
        with self._lock:
            self._pulse += 1
            self._pulsed_s = {
                number: at for number, at in self._pulsed_s.items() if now_s - at <= self.absent_s
            }
            self._pulsed_s[self._pulse] = now_s
            return self._pulse

    def hear(self, beat: Heartbeat, now_s: float) -> None:
        """Accept a heartbeat that answers a recent pulse if no other operator is present."""
        with self._lock:
            answered_s = self._pulsed_s.get(beat.answers, -math.inf)
            last = self._operator
            if now_s - answered_s > self.absent_s:
                theirs = False
            elif last is not None and beat.session == last.session:
                theirs = beat.sequence > last.sequence
                answered_s = max(answered_s, last.answered_s)
            else:
                theirs = self.operator is None
            if theirs:
                was_there = self.operator is not None
                self._operator = _Operator(
                    beat.session, beat.name, beat.sequence, answered_s, beat.present
                )
                if was_there and not beat.present and self.attended:
                    self._latch("operator_lost")

    def watch(self, now_s: float) -> None:
        """Latch a stop if the operator has answered no pulse for too long."""
        with self._lock:
            last = self._operator
            if last is not None and last.there and now_s - last.answered_s > self.absent_s:
                self._operator = replace(last, there=False)
                self._latch("operator_lost")

    def not_theirs(self, session: str) -> str | None:
        """Return why a session is denied; a present operator has the sole permission."""
        operator = self._operator
        if operator is not None and operator.there and operator.session != session:
            return f"permission denied: only the operator (at {operator.name}) may do that"
        return None

    # -- episodes ----------------------------------------------------------------------------------

    @property
    def taken_over(self) -> bool:
        """Whether a person has taken over from the driver."""
        return self._taken_over

    def begin(self, episode: str, driver: Source) -> None:
        """Start an episode: forget every command and name the driver. A latched stop stays."""
        with self._lock:
            self._begin(episode, driver)

    def _begin(self, episode: str, driver: Source) -> None:
        self._episode = episode
        self._driver = driver
        self._taken_over = False
        self._captured_s: dict[int, float] = {}
        self._latest: dict[Source, _Accepted] = {}
        self.refused: Counter[Refusal] = Counter()

    def resume(self, episode: str | None, tick: int, session: str) -> str | None:
        """Return control to the driver after a person took over, or return why not.

        Earlier commands expire. Episode and tick belong to the newest frame that the person
        received; the episode is None between episodes.
        """
        with self._lock:
            mine = self._latest.get("teleop")
            if episode is not None and (
                episode != self._episode or (mine is not None and mine.command.tick > tick)
            ):
                return "another episode has begun, or the person has commanded since; resume again"
            refusal = self.not_theirs(session)
            if refusal is None:
                self._taken_over = False
                self._expire()
            return refusal

    def _expire(self) -> None:
        # Their order stays: a repeated command is refused.
        self._latest = {
            source: replace(one, until_s=-math.inf) for source, one in self._latest.items()
        }

    def captured(self, tick: int, now_s: float) -> None:
        """Store the capture time of a frame; forget frames that are too old for a fresh command."""
        with self._lock:
            self._captured_s = {
                t: at for t, at in self._captured_s.items() if now_s - at <= self.max_age_s
            }
            self._captured_s[tick] = now_s

    # -- commands ----------------------------------------------------------------------------------

    def offer(self, command: Command, now_s: float) -> Refusal | None:
        """Accept a command, or return why it is refused.

        An emergency stop is always accepted, whatever its age, order and episode: it can only stop
        the robot. It stays until ``arm`` releases it. A person's command takes over from any other
        driver until ``resume``; if the person falls silent, the robot stands.
        """
        if command.source == "emergency_stop":
            self.stop()
            return None
        with self._lock:
            refusal = self._check(command, now_s)
            if refusal is not None:
                self.refused[refusal] += 1
                return refusal
            self._taken_over = self._taken_over or command.source != self._driver
            captured_s = self._captured_s[command.tick]
            until_s = min(captured_s + self.max_age_s, now_s + SILENCE_S)
            self._latest[command.source] = _Accepted(command, captured_s, now_s, until_s)
            return None

    def _check(self, command: Command, now_s: float) -> Refusal | None:
        refusal = self._check_sender(command, now_s)
        if refusal is not None:
            return refusal
        # NaN fails both comparisons.
        if not all(-1.0 <= share <= 1.0 for share in command.velocity):
            return "not finite"
        last = self._latest.get(command.source)
        if (
            last is not None
            and last.command.session == command.session
            and (command.tick, command.sequence) <= last.order
        ):
            return "out of order"
        captured_s = self._captured_s.get(command.tick)
        if captured_s is None:
            # The frame was forgotten because of its age, or never captured.
            return (
                "stale"
                if self._captured_s and command.tick < min(self._captured_s)
                else "unknown frame"
            )
        return "stale" if now_s - captured_s > self.max_age_s else None

    def _check_sender(self, command: Command, now_s: float) -> Refusal | None:
        if command.episode != self._episode:
            return "wrong episode"
        if command.source not in ("teleop", self._driver):
            return "not the driver"
        if command.source == "teleop" and self.not_theirs(command.session):
            return "not the operator"
        last = self._latest.get(command.source)
        if (
            last is not None
            and last.command.session != command.session
            and now_s - last.offered_s <= LEASE_S
        ):
            return "another session"
        return None

    @property
    def answered_s(self) -> float | None:
        """Capture time of the last frame for which the driver has commanded, if any."""
        with self._lock:
            latest = self._latest.get(self._driver)
            return None if latest is None else latest.captured_s

    def expect_anybody(self) -> None:
        """End the leases: in lockstep time stands, and a restarted driver must be accepted."""
        with self._lock:
            self._latest = {
                source: replace(one, offered_s=-math.inf) for source, one in self._latest.items()
            }

    def answered(self, tick: int) -> bool:
        """Return whether the driver has commanded for this frame."""
        with self._lock:
            latest = self._latest.get(self._driver)
            return latest is not None and latest.command.tick == tick

    def applied(self, now_s: float, *, deaf: bool = False) -> Applied:
        """Return the motion of the actuator: the fresh command of the current driver, or standing.

        While a stop might not reach the robot (``deaf``) it stands, without a latched stop. The
        loss of an operator is latched separately, and an operator repeats a stop until the robot
        reports it. The guard runs without the lock, so that no stop waits for it. Changes during
        that time count: a stop, another command, or another episode.
        """
        latest = self._obeyed(now_s, deaf=deaf)
        while not isinstance(latest, Applied):
            command = latest.command
            insists = command.insists and command.source == "teleop"
            may, reason = bounded(
                command.velocity, self.kinematics, self.guard, now_s, insists=insists
            )
            asked = latest
            latest = self._obeyed(now_s, deaf=deaf)
            if latest is asked:
                return Applied(may, command.source, reason, command.tick, now_s - asked.captured_s)
        return latest

    def _obeyed(self, now_s: float, *, deaf: bool) -> _Accepted | Applied:
        """Return the obeyed command, or why the robot stands."""
        with self._lock:
            if self.latched_stop:
                cause: Source | None = "emergency_stop" if self._cause == "emergency_stop" else None
                return Applied(STANDING, cause, "latched_stop")
            if deaf:
                return Applied(STANDING, None, "deaf")
            latest = self._latest.get("teleop" if self._taken_over else self._driver)
            if latest is None or now_s > latest.until_s:
                return Applied(STANDING, None, "taken_over" if self._taken_over else "silence")
            return latest

    def carries_out(self, velocity: Velocity, now_s: float) -> None:
        """Store the velocity that the actuator executes from now on."""
        if self.wheels is not None:
            self.wheels.told(velocity, now_s)


def bounded(
    asked: Velocity,
    kinematics: Kinematics,
    guard: Guard | None,
    now_s: float,
    *,
    insists: bool = False,
) -> tuple[Velocity, Limit]:
    """Return the feasible, safe velocity nearest to a command, and its reason."""
    may = kinematics.bounded(asked)
    share = 1.0 if guard is None else guard.share(may, now_s)
    if guard is not None and share < abs(may.linear):
        reason: Limit = "obstacle" if guard.sees(now_s) else "no_depth"
        if insists and share < INSISTED:
            reason = "insisted"
        # Slower along the same arc. If it must stop, a robot (but not a car) can still turn on the
        # spot.
        slower = min(INSISTED if reason == "insisted" else share, abs(may.linear)) / abs(may.linear)
        return kinematics.bounded(
            Velocity(slower * may.linear, (slower or 1.0) * may.angular)
        ), reason
    return may, "command" if may == asked else "radius"

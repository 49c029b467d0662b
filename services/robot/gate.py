"""The last check before the wheels: which command the actuator obeys, if any.

Everything is judged on the actuator's own clock. A command names the frame (tick) that it descends from, and the gate
remembers when it captured that frame; so neither a wrong clock in another process, nor a clock that jumps, nor a
process that was frozen and wakes with old plans can make an old command look fresh. An operator's sign of life names
the pulse that it answers, and is as old as that: by a slow link nobody who was there looks as if they were there now.
"""

import math
import secrets
from collections import Counter
from dataclasses import dataclass, field, replace
from threading import Lock
from typing import Final, Literal

from schemas.base import STANDING, Source, Velocity
from schemas.command import Command, StopCause
from schemas.heartbeat import Heartbeat
from services.robot.body import Kinematics
from services.robot.guard import Guard
from services.robot.wheels import WheelCheck

#: Silence at which a command is no longer obeyed, seconds since it came. The robot must stand 0.5 s after the last
#: command; the rest is for braking, see `services.robot.loop`.
SILENCE_S: Final = 0.25
#: Age at which it is not either, seconds since the capture of the frame that it descends from, unless the robot's
#: settings say more. So on one machine, where answers come at once, silence is counted from the last answered frame.
MAX_AGE_S: Final = SILENCE_S
#: Age of the last pulse that was answered at which an operator is lost, seconds; five pulses. The answer may take what
#: is left of that after one, 0.2 s, to and fro.
OPERATOR_S: Final = 0.25
#: Silence after which another process of the same kind may command in place of one that was heard, seconds; a killed
#: one that is started again takes longer.
LEASE_S: Final = 1.0
INSISTED: Final = 0.2  # Share of its speed at which a robot goes on for a person who insists: it stands within a hand.
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
Reason = Literal[
    "command",
    "obstacle",
    "no_depth",
    "insisted",
    "radius",
    "silence",
    "taken_over",
    "deaf",
    "emergency_stop",
]
#: The last of several causes is reported: the operator has to know it to arm the robot.
_WEIGHT: Final[tuple[StopCause, ...]] = (
    "not_armed",
    "operator_lost",
    "wheels",
    "fault",
    "emergency_stop",
)


@dataclass(frozen=True)
class Applied:
    """What the actuator does now, and which frame's command made it do so."""

    velocity: Velocity
    source: Source | None
    reason: Reason
    answered_tick: int | None = None
    age_s: float = field(
        default=0.0, compare=False
    )  # Age of the command, since the capture of its frame.


@dataclass(frozen=True)
class _Accepted:
    command: Command
    captured_s: float
    offered_s: float
    until_s: float  # When it is no longer obeyed.

    @property
    def order(self) -> tuple[int, int]:
        return self.command.tick, self.command.sequence


@dataclass(frozen=True)
class _Operator:
    """Whoever was the operator last; one who has left is kept, so that an old sign of life does not bring them back."""

    session: str
    name: str
    sequence: int
    answered_s: float  # When the newest pulse was sent that they have answered.
    there: bool


class CommandGate:
    """Arbitrates between the sources of commands for one robot; every method may be called on any thread.

    It begins with a stop latched, as `not_armed`: a robot that is started again moves for nobody until it is armed. The
    first stop has a number by chance, so that none from before a restart is released; ``first_stop`` sets it.

    A command expires `SILENCE_S` after it came, and at an age counted from the capture of its frame: what a slow link
    holds up is obeyed for less long, or not at all, and never stretches the silence. With ``attended``, an operator
    must be there for the robot to move.
    """

    def __init__(
        self, max_age_s: float = MAX_AGE_S, *, attended: bool = False, first_stop: int | None = None
    ) -> None:
        self.max_age_s = max_age_s
        #: What bounds the speed of whoever drives, where the robot sees what it may run into; and how it can move.
        self.guard: Guard | None = None
        self.wheels: WheelCheck | None = None  # Compares what is carried out with the odometry.
        self.kinematics = Kinematics(1.0, 1.0)
        self.attended = attended
        self._lock = Lock()
        self._stops = first_stop or 1 + secrets.randbits(48)
        self._released = 0
        self._cause: StopCause = "not_armed"
        self._operator: _Operator | None = None
        # By chance, so that no answer to a pulse from before a restart is one to another now.
        self._pulse = secrets.randbits(48)
        self._pulsed_s: dict[int | None, float] = {}
        self._begin("", "policy")

    # -- stops ----------------------------------------------------------------------------------------------------

    @property
    def emergency_stop(self) -> int:
        """Number of the latched stop; 0 where none is."""
        return self._stops if self._stops != self._released else 0

    @property
    def stop_cause(self) -> StopCause | None:
        """What latched it."""
        return self._cause if self.emergency_stop else None

    def stop(self, cause: StopCause = "emergency_stop") -> None:
        """Latch a stop; of several causes the graver one is told until the robot is armed."""
        with self._lock:
            self._latch(cause)

    def _latch(self, cause: StopCause) -> None:
        self._cause = max(self.stop_cause or cause, cause, key=_WEIGHT.index)
        self._stops += 1

    def arm(self, stop: int, session: str) -> str | None:
        """Release a stop by its number, or say why not.

        Whoever releases one does not release another that came meanwhile. Nothing that was asked before counts, and a
        driver that drove before does not go on: that takes ``resume``, or the next episode.
        """
        with self._lock:
            refusal = self.not_theirs(session)
            if refusal is not None:
                return refusal
            if self.attended and self.operator is None:
                return "no operator answers in time; this robot moves only while one does"
            if not self.emergency_stop or stop != self.emergency_stop:
                return (
                    "another stop was latched meanwhile"
                    if self.emergency_stop
                    else "no stop is latched"
                )
            self._taken_over = self._episode != ""
            self._expire()
            self._released = stop
            return None

    # -- the operator ---------------------------------------------------------------------------------------------

    @property
    def operator(self) -> str | None:
        """Session of the operator who is there, if any."""
        operator = self._operator
        return operator.session if operator is not None and operator.there else None

    def pulse(self, now_s: float) -> int:
        """Return the number of the pulse that is sent now; older ones than an operator may answer are forgotten."""
        with self._lock:
            self._pulse += 1
            self._pulsed_s = {
                number: at for number, at in self._pulsed_s.items() if now_s - at <= OPERATOR_S
            }
            self._pulsed_s[self._pulse] = now_s
            return self._pulse

    def hear(self, beat: Heartbeat, now_s: float) -> None:
        """Take an operator's sign of life, unless it answers no recent pulse, or another operator is there."""
        with self._lock:
            answered_s = self._pulsed_s.get(beat.answers, -math.inf)
            last = self._operator
            if now_s - answered_s > OPERATOR_S:
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
        """Latch a stop where the operator has answered no pulse for too long, by the clock of ``pulse``."""
        with self._lock:
            last = self._operator
            if last is not None and last.there and now_s - last.answered_s > OPERATOR_S:
                self._operator = replace(last, there=False)
                self._latch("operator_lost")

    def not_theirs(self, session: str) -> str | None:
        """Say why a session may not do something; where an operator is there, it is the operator's alone to do."""
        operator = self._operator
        if operator is not None and operator.there and operator.session != session:
            return f"only the operator (at {operator.name}) may do that"
        return None

    # -- episodes -------------------------------------------------------------------------------------------------

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
        """Let the driver go on after a person had taken over, or say why not; what was asked before no longer counts.

        Episode and tick are of the newest frame that the person had heard of; there is no episode where none runs.
        """
        with self._lock:
            mine = self._latest.get("teleop")
            if episode is not None and (
                episode != self._episode or (mine is not None and mine.command.tick > tick)
            ):
                return "another episode has begun, or the person has commanded since"
            refusal = self.not_theirs(session)
            if refusal is None:
                self._taken_over = False
                self._expire()
            return refusal

    def _expire(self) -> None:
        # Their order goes on to count: a command that comes twice is refused.
        self._latest = {
            source: replace(one, until_s=-math.inf) for source, one in self._latest.items()
        }

    def captured(self, tick: int, now_s: float) -> None:
        """Remember when a frame was captured; older frames than any fresh command may name are forgotten."""
        with self._lock:
            self._captured_s = {
                t: at for t, at in self._captured_s.items() if now_s - at <= self.max_age_s
            }
            self._captured_s[tick] = now_s

    # -- commands -------------------------------------------------------------------------------------------------

    def offer(self, command: Command, now_s: float) -> Refusal | None:
        """Take a command, or say why not.

        An emergency stop is taken whatever its age, order and episode, and without an episode too: it can only make
        the robot stand. It stays until ``arm`` releases it. A person's command takes over from any other driver, for
        good: where the person falls silent the robot stands until ``resume``.
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
        if not all(
            -1.0 <= share <= 1.0 for share in command.velocity
        ):  # NaN is not between them either
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
            # Either forgotten because it is too old, or never captured at all.
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

    def expect_anybody(self) -> None:
        """End the leases: in lockstep time stands, and a driver that was started again has to be heard."""
        with self._lock:
            self._latest = {
                source: replace(one, offered_s=-math.inf) for source, one in self._latest.items()
            }

    def answered(self, tick: int) -> bool:
        """Whether the driver has commanded for this very frame."""
        with self._lock:
            latest = self._latest.get(self._driver)
            return latest is not None and latest.command.tick == tick

    def applied(self, now_s: float, *, deaf: bool = False) -> Applied:
        """Return what the actuator has to do now: the fresh command of whoever drives, or stand.

        While a stop might not reach the robot (``deaf``) it stands. Then it goes on by itself: the loss of an operator
        is latched as such, and an operator repeats a stop until the robot reports that it stands for it.
        The guard is asked without the lock: no stop waits for it. What came meanwhile counts: a stop, another command,
        or another episode.
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
        """Return the command that is obeyed now, or why the robot stands."""
        with self._lock:
            if self.emergency_stop:
                cause: Source | None = "emergency_stop" if self._cause == "emergency_stop" else None
                return Applied(STANDING, cause, "emergency_stop")
            if deaf:
                return Applied(STANDING, None, "deaf")
            latest = self._latest.get("teleop" if self._taken_over else self._driver)
            if latest is None or now_s > latest.until_s:
                return Applied(STANDING, None, "taken_over" if self._taken_over else "silence")
            return latest

    def carries_out(self, velocity: Velocity, now_s: float) -> None:
        """Take what the actuator carries out from now on."""
        if self.wheels is not None:
            self.wheels.told(velocity, now_s)


def bounded(
    asked: Velocity,
    kinematics: Kinematics,
    guard: Guard | None,
    now_s: float,
    *,
    insists: bool = False,
) -> tuple[Velocity, Reason]:
    """Return how a robot moves that is asked to, and why: no more sharply than it can, nor fast into anything."""
    may = kinematics.bounded(asked)
    share = 1.0 if guard is None else guard.share(may, now_s)
    if guard is not None and share < abs(may.linear):
        reason: Reason = "obstacle" if guard.sees(now_s) else "no_depth"
        if insists and share < INSISTED:
            reason = "insisted"
        # Slower along the same arc; where it may not go on at all it may turn on the spot, but not as a car.
        slower = min(INSISTED if reason == "insisted" else share, abs(may.linear)) / abs(may.linear)
        return kinematics.bounded(
            Velocity(slower * may.linear, (slower or 1.0) * may.angular)
        ), reason
    return may, "command" if may == asked else "radius"

"""The last thread before the wheels: gate, then body, 50 times a second, without waiting."""

import logging
import threading
from collections.abc import Callable
from typing import Final

from schemas.base import STANDING
from services.kit.errors import foreign_error, out_of_memory
from services.kit.node import ServiceError
from services.kit.throttle import Throttle
from services.robot.body import Body, Stops, View
from services.robot.clock import ABSENT_S, SILENCE_S, now_s
from services.robot.gate import Applied, CommandGate

# Period of the loop.
PERIOD_S: Final = 0.02
# Time limit to stand after the source of motion falls silent.
STAND_WITHIN_S: Final = 0.5
_log = logging.getLogger("robot")


def stopping_times_s(body: Stops) -> dict[str, float]:
    """Return the maximum stopping times in seconds by the silent part: the sum of all delays."""
    return {
        "the driver": SILENCE_S + PERIOD_S + body.braking_s,
        "the operator": ABSENT_S + PERIOD_S + body.braking_s,
        "a link": ABSENT_S + PERIOD_S + body.braking_s,
        "this process": body.watchdog_s + body.braking_s,
    }


def check_stopping(body: Stops) -> None:
    """Raise ServiceError if a body moves for longer than `STAND_WITHIN_S` after a silence."""
    for who, stands_s in stopping_times_s(body).items():
        if not stands_s <= STAND_WITHIN_S:
            raise ServiceError(
                f"{body.name}: stopping time after the silence of {who} is too large "
                f"({stands_s:.2f} s > maximum {STAND_WITHIN_S:g} s; braking takes "
                f"{body.braking_s:.2f} s, its watchdog {body.watchdog_s:.2f} s)"
            )


class ActuatorLoop:
    """Executes the gate's command on a thread, until it is closed.

    If the body fails, a stop is latched: after a fault a person must inspect the robot and arm it.
    ``tell`` receives each change of the executed command, and must not wait. While the robot is
    ``deaf`` to stops or commands it stands.
    """

    def __init__(
        self,
        gate: CommandGate,
        body: Body[View],
        tell: Callable[[Applied], None],
        clock: Callable[[], float] = now_s,
        deaf: Callable[[], bool] = lambda: False,
    ) -> None:
        self._gate = gate
        self._deaf = deaf
        self._body = body
        self._tell = tell
        self._clock = clock
        self._told: tuple[object, ...] | None = None
        self._complaints = Throttle()
        self._last_complaints = Throttle()
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name="actuator", daemon=True)
        self.late = 0  # Number of steps that began later than the next step was due.
        #: Age of the executed command, since the capture of its frame, at the start of its
        #: execution.
        self.delay_s = 0.0
        self._error: str | None = None  # Last error of the body, one line.
        self._answered: int | None = None

    @property
    def fault(self) -> str | None:
        """Error of the body for which it stands until it is armed; None without one."""
        return self._error if self._gate.stop_cause == "fault" else None

    def start(self) -> None:
        """Start the loop."""
        self._thread.start()

    def close(self) -> None:
        """Stop the loop, and leave the robot standing."""
        self._ended.set()
        if self._thread.ident is not None:
            self._thread.join()
        self._stand()

    def step(self) -> None:
        """Execute the gate's current command."""
        try:
            self._carry_out()
        except Exception as error:
            self._gate.stop("fault")
            expected = isinstance(error, ServiceError)
            self._error = str(error) if expected else foreign_error(error)
            if out_of_memory(error):
                self._stand()
                raise  # Ends the process.
            if self._complaints.due():
                _log.error(
                    "the body has failed; the robot stands until it is armed: %s",
                    error,
                    exc_info=not expected,
                )
            self._stand()

    def _carry_out(self) -> None:
        now = self._clock()
        self._gate.watch(now)
        applied = self._gate.applied(now, deaf=self._deaf())
        carried_out = STANDING
        if applied.velocity == STANDING:
            self._body.stand()
        else:
            carried_out = self._body.drive(applied.velocity)
        self._gate.carries_out(carried_out, now)
        if applied.answered_tick not in (None, self._answered):
            self._answered = applied.answered_tick
            self.delay_s = applied.age_s
        what = (applied.velocity, applied.source, applied.reason)
        if what != self._told:
            self._told = what
            self._tell(applied)

    def _run(self) -> None:
        due_s = self._clock()
        while not self._ended.wait(max(0.0, due_s - self._clock())):
            now = self._clock()
            self.late += now - due_s > PERIOD_S
            # A simulated clock can stand still meanwhile.
            due_s = max(min(due_s, now) + PERIOD_S, now)
            self.step()

    def _stand(self) -> None:
        self._gate.carries_out(STANDING, self._clock())
        try:
            self._body.stand()
        except Exception:  # noqa: BLE001 - nothing more can be done here
            if self._last_complaints.due():
                _log.exception("the body failed to stand; its watchdog must stop it")

"""The command gate: only fresh, finite, ordered commands of the highest source move the robot."""

import pickle
import threading

import pytest

from schemas.base import KEYS, STANDING, Source
from schemas.command import Command, StopCause
from services.robot.body import Kinematics
from services.robot.gate import MAX_AGE_S, Applied, CommandGate
from tests.services.robot.gating import beat, command

STAND = Applied(STANDING, None, "silence")
THEIRS = "permission denied: only the operator (at desk) may do that"


def hear(
    gate: CommandGate, session: str, sequence: int, now_s: float, *, present: bool = True
) -> None:
    """Have an operator answer a pulse at once."""
    gate.hear(beat(session, sequence, gate.pulse(now_s), present=present), now_s)


def armed(max_age_s: float = MAX_AGE_S, *, attended: bool = False) -> CommandGate:
    gate = CommandGate(max_age_s, attended=attended, first_stop=1)
    if attended:
        hear(gate, "o", 0, 0.0)
    assert gate.arm(1, "o" if attended else "") is None
    return gate


def begun(gate: CommandGate) -> CommandGate:
    gate.begin("e", "policy")
    gate.captured(0, 10.0)
    return gate


@pytest.fixture
def gate() -> CommandGate:
    return begun(armed())


@pytest.mark.parametrize(
    ("offered", "now_s", "refusal"),
    [
        (command(0, episode="a"), 10.1, "wrong episode"),
        (command(0, episode="other"), 10.1, "wrong episode"),
        (command(0, source="expert"), 10.1, "not the driver"),
        (command(1), 10.1, "unknown frame"),
        (command(0), 10.46, "stale"),
        (command(0, linear=float("nan")), 10.1, "not finite"),
        (command(0, linear=float("inf")), 10.1, "not finite"),
        (command(0, linear=1.01), 10.1, "not finite"),
        (command(0, linear=1.5), 10.1, "not finite"),
        (command(0, linear=-1.01), 10.1, "not finite"),
    ],
)
def test_refusals_are_named_counted_and_harmless(
    gate: CommandGate, offered: Command, now_s: float, refusal: str
) -> None:
    assert gate.offer(offered, now_s) == refusal
    assert gate.refused == {refusal: 1}
    assert gate.applied(now_s) == STAND


def test_a_command_expires_after_its_last_moment_and_not_in_it() -> None:
    gate = begun(armed(0.5))  # which floating point represents exactly
    gate.captured(1, 10.5)
    assert gate.offer(command(0), 10.5) is None, "a slow link is allowed for"
    assert gate.applied(10.5).answered_tick == 0
    assert gate.applied(10.500001) == STAND
    assert gate.offer(command(0, sequence=1), 10.500001) == "stale"
    gate.captured(2, 10.6)
    assert gate.offer(command(0, sequence=1), 10.6) == "stale"


def test_a_gate_that_runs_for_long_stays_small(gate: CommandGate) -> None:
    def size() -> int:
        return len(
            pickle.dumps({name: value for name, value in vars(gate).items() if name != "_lock"})
        )

    for tick in range(10):
        gate.captured(tick, 10.0 + 0.1 * tick)
        gate.pulse(10.0 + 0.1 * tick)
        gate.offer(command(tick), 10.0 + 0.1 * tick)
    after_a_second = size()
    for tick in range(10, 1000):
        gate.captured(tick, 10.0 + 0.1 * tick)
        gate.pulse(10.0 + 0.1 * tick)
    gate.offer(command(999), 10.0 + 0.1 * 999)
    assert size() < after_a_second + 100


@pytest.mark.parametrize("driver", ["policy", "expert"])
def test_robot_stands_after_a_takeover_until_it_is_resumed(
    driver: Source,
) -> None:
    gate = armed()
    gate.begin("e", driver)
    gate.captured(0, 10.0)
    gate.offer(command(0, source=driver), 10.0)
    assert not gate.taken_over
    assert gate.offer(command(0, source="teleop", atom="left"), 10.0) is None
    assert gate.taken_over
    gate.captured(3, 10.1)
    assert gate.offer(command(3, source=driver), 10.1) is None, (
        "what it would do is heard, for lockstep"
    )
    assert gate.answered(3)
    assert gate.applied(10.2) == Applied(KEYS["left"], "teleop", "command", answered_tick=0)
    # The link is lost, or the key let go: the driver does not go on by itself, however long that lasts.
    for now_s in (10.0 + MAX_AGE_S + 0.01, 11.0, 1000.0):
        gate.captured(round(now_s), now_s)
        gate.offer(command(round(now_s), source=driver), now_s)
        assert gate.applied(now_s) == Applied(STANDING, None, "taken_over")
    assert gate.resume("e", 1000, "") is None
    assert not gate.taken_over
    assert gate.applied(1000.0) == STAND
    gate.captured(1001, 1000.1)
    gate.offer(command(1001, source=driver), 1000.1)
    assert gate.applied(1000.1).source == driver


def test_started_robot_stands_until_it_is_armed() -> None:
    gate = CommandGate()
    assert gate.stop_cause == "not_armed"
    assert begun(gate).offer(command(0), 10.0) is None, "what it would do is heard"
    assert gate.applied(10.0) == Applied(STANDING, None, "latched_stop")
    assert gate.arm(gate.latched_stop, "") is None
    assert gate.stop_cause is None


def test_no_stop_from_before_a_restart_is_released_after_it() -> None:
    numbers = {CommandGate().latched_stop for _ in range(100)}
    assert len(numbers) == 100
    assert all(0 < number < 2**62 for number in numbers)
    assert all(abs(one - other) > 10 for one in numbers for other in numbers if one != other)


@pytest.mark.parametrize("number", [1, 2, 4, 0])
def test_a_stop_is_released_by_its_own_number_alone(gate: CommandGate, number: int) -> None:
    gate.stop()
    gate.stop()
    assert gate.arm(number, "") == "another stop was latched since; arm again"
    assert gate.latched_stop == 3
    assert gate.arm(3, "") is None
    assert gate.latched_stop == 0
    assert gate.arm(number, "") == "no stop is latched"
    # Released once: the number is not good for the next one.
    gate.stop()
    assert gate.arm(3, "") == "another stop was latched since; arm again"
    assert gate.latched_stop == 4


def test_graver_stop_cause_is_reported_in_any_order() -> None:
    for graver, other in (
        ("fault", "operator_lost"),
        ("operator_lost", "not_armed"),
        ("emergency_stop", "fault"),
    ):
        for causes in ((graver, other), (other, graver)):
            gate = armed()
            for cause in causes:
                gate.stop(cause)
            assert gate.stop_cause == graver
            source = "emergency_stop" if graver == "emergency_stop" else None
            assert gate.applied(0.0).source == source


class Interrupted(CommandGate):
    """A gate of which another thread stops the robot for an emergency, in the middle of its latching another stop."""

    @property
    def stop_cause(self) -> StopCause | None:
        found = super().stop_cause
        if getattr(self, "other", None) is None:
            self.other = threading.Thread(target=self.stop)
            self.other.start()
            self.other.join(0.001)  # it waits, or has done it
        return found


@pytest.mark.parametrize("how", ["stop", "silence", "good bye"])
def test_emergency_stop_is_not_hidden_by_another_stop(how: str) -> None:
    gate = Interrupted(attended=True, first_stop=1)
    hear(gate, "o", 0, 10.0)
    if how == "stop":
        gate.stop("fault")
    elif how == "silence":
        gate.watch(11.0)
    else:
        hear(gate, "o", 1, 10.0, present=False)
    gate.other.join()
    assert (gate.stop_cause, gate.latched_stop) == ("emergency_stop", 3)


@pytest.mark.parametrize("sequence", [0, 1])
def test_heartbeat_counts_once_and_in_order(gate: CommandGate, sequence: int) -> None:
    hear(gate, "o", 1, 10.0)
    hear(gate, "o", sequence, 10.2)
    gate.watch(10.1 + gate.absent_s)
    assert gate.stop_cause == "operator_lost"


@pytest.mark.parametrize(("attended", "lost"), [(True, "operator_lost"), (False, None)])
def test_unattended_robot_tolerates_a_busy_computer(attended: bool, lost: str | None) -> None:
    gate = CommandGate(attended=attended)
    hear(gate, "o", 1, 10.0)
    gate.arm(gate.latched_stop, "o")
    gate.watch(10.9)
    assert gate.stop_cause == lost


@pytest.mark.parametrize("off", [-1, 1, 7, None])
def test_heartbeat_without_a_valid_pulse_is_ignored(gate: CommandGate, off: int | None) -> None:
    pulse = gate.pulse(10.0)
    gate.hear(beat("o", 0, None if off is None else pulse + off), 10.0)
    assert gate.operator is None


def test_no_pulse_from_before_a_restart_is_one_after_it() -> None:
    numbers = [CommandGate().pulse(0.0) for _ in range(100)]
    assert len({number // 1000 for number in numbers}) == 100
    assert all(0 < number < 2**62 for number in numbers)


@pytest.mark.parametrize("other", ["n", "p"])
def test_one_operator_at_a_time(gate: CommandGate, other: str) -> None:
    hear(gate, "o", 0, 10.0)
    hear(gate, other, 7, 10.1)
    hear(gate, other, 8, 10.1, present=False)
    assert gate.operator == "o"
    assert gate.offer(command(0, source="teleop", session=other), 10.0) == "not the operator"
    gate.stop()
    assert gate.arm(2, other) == gate.arm(7, other) == THEIRS
    assert gate.latched_stop == 2
    assert gate.arm(2, "o") is None
    assert gate.resume("e", 0, other) == THEIRS
    assert gate.taken_over
    assert gate.resume("e", 0, "o") is None
    assert gate.offer(command(0, source="teleop", session="o"), 10.0) is None
    hear(gate, "o", 1, 10.1, present=False)
    hear(gate, other, 9, 10.2)
    assert gate.operator == other


def test_an_attended_robot_moves_only_while_an_operator_is_there() -> None:
    gate = CommandGate(attended=True, first_stop=1)
    assert (
        gate.arm(1, "o")
        == "no operator answers in time; this robot moves only with a present operator"
    )
    hear(gate, "o", 0, 10.0)
    assert gate.arm(1, "x") == THEIRS
    assert gate.arm(1, "o") is None
    begun(gate).offer(command(0), 10.0)
    hear(gate, "o", 1, 10.05)
    assert gate.applied(10.0).velocity == KEYS["forward"]
    hear(gate, "o", 2, 10.1, present=False)
    assert (gate.latched_stop, gate.stop_cause) == (2, "operator_lost")


def test_process_holds_the_lease_until_it_is_silent(gate: CommandGate) -> None:
    for tick in (1, 2, 3):
        gate.captured(tick, 10.0)
    assert gate.offer(command(1, session="a", sequence=1_000_000), 10.0) is None
    for other in ("0", "b"):
        assert gate.offer(command(2, session=other, atom="left"), 10.0) == "another session"
    assert gate.applied(10.0).velocity == KEYS["forward"]
    assert gate.offer(command(2, session="a"), 10.0) is None, (
        "no number locks the rightful sender out"
    )
    late_s = 11.0
    gate.captured(12, late_s)
    assert gate.offer(command(12, session="b"), late_s) == "another session"
    gate.captured(13, late_s + 0.001)
    assert gate.offer(command(13, session="b"), late_s + 0.001) is None
    assert gate.offer(command(13, session="a", sequence=9), late_s + 0.001) == "another session"
    assert gate.applied(late_s + 0.001).answered_tick == 13


@pytest.mark.parametrize(("first", "second"), ["ab", "ba"])
def test_the_order_of_another_process_is_its_own(
    gate: CommandGate, first: str, second: str
) -> None:
    gate.captured(1, 10.0)
    assert gate.offer(command(1, session=first, sequence=5), 10.0) is None
    gate.expect_anybody()
    assert gate.offer(command(1, session=second), 10.0) is None
    assert gate.offer(command(1, session=second), 10.0) == "out of order"


def test_how_old_the_command_is_that_moves_the_robot_is_told(gate: CommandGate) -> None:
    assert gate.applied(10.1).age_s == 0.0
    gate.offer(command(0), 10.05)
    assert gate.applied(10.1).age_s == pytest.approx(0.1)
    assert gate.applied(10.2).age_s == pytest.approx(0.2)


@pytest.mark.parametrize(
    ("asked", "goes", "reason"),
    [
        ((0.0, 1.0), (0.0, 0.0), "radius"),
        ((0.5, -1.0), (0.5, -0.5), "radius"),
        ((-1.0, 1.0), (-1.0, 1.0), "command"),
    ],
)
def test_car_turns_no_more_sharply_than_its_radius(
    gate: CommandGate, asked: tuple[float, float], goes: tuple[float, float], reason: str
) -> None:
    gate.kinematics = Kinematics(2.0, 2.0 / 1.5, 1.5)
    for source in ("policy", "teleop"):
        wanted = command(0, source=source).model_copy(
            update={"linear": asked[0], "angular": asked[1]}
        )
        assert gate.offer(wanted, 10.1) is None
        applied = gate.applied(10.2)
        assert (applied.velocity, applied.reason, applied.source) == (goes, reason, source)

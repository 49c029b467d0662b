"""The command gate: nothing moves the robot unless it is fresh, finite, in order and from the highest source."""

from __future__ import annotations

import math
import pickle
import threading
from collections.abc import Callable
from itertools import pairwise

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule

from schemas.base import SOURCES, Atom, Source
from schemas.command import Command, StopCause
from schemas.heartbeat import Heartbeat
from services.robot.gate import LEASE_S, MAX_AGE_S, OPERATOR_S, Applied, CommandGate

STAND = Applied("stop", 0.0, None, "silence")
THEIRS = "only the operator (at desk) may do that"


def command(
    tick: int,
    *,
    sequence: int = 0,
    source: Source = "policy",
    atom: Atom = "forward",
    episode: str = "e",
    speed: float = 1.0,
    session: str = "",
) -> Command:
    header = {"robot": "r", "episode": episode, "tick": tick, "stamp_ns": 0}
    whole = Command(**header, source=source, session=session, sequence=sequence, atom=atom)
    # The schema would refuse what the gate has to refuse by itself.
    return whole.model_copy(update={"speed": speed})


def beat(session: str, sequence: int, answers: int | None, *, present: bool = True) -> Heartbeat:
    header = {"robot": "r", "episode": "e", "tick": 0, "stamp_ns": 0}
    return Heartbeat(**header, session=session, name="desk", sequence=sequence, answers=answers, present=present)


def hear(gate: CommandGate, session: str, sequence: int, now_s: float, *, present: bool = True) -> None:
    """Have an operator answer a pulse at once."""
    gate.hear(beat(session, sequence, gate.pulse(now_s), present=present), now_s)


def armed(max_age_s: float = MAX_AGE_S, *, attended: bool = False) -> CommandGate:
    gate = CommandGate(max_age_s, attended=attended, first_stop=1)
    if attended:
        hear(gate, "o", 0, 0.0)
    assert gate.arm(1, "o" if attended else "") is None
    return gate


@pytest.fixture
def gate() -> CommandGate:
    gate = armed()
    gate.begin("e", "policy")
    gate.captured(0, 10.0)
    return gate


def test_fresh_command_moves_the_robot_and_silence_stops_it(gate: CommandGate) -> None:
    assert gate.offer(command(0), 10.1) is None
    assert gate.applied(10.2) == Applied("forward", 1.0, "policy", "command", answered_tick=0)
    assert gate.applied(10.0 + MAX_AGE_S).atom == "forward"
    assert gate.applied(10.0 + MAX_AGE_S + 1e-6) == STAND


@pytest.mark.parametrize(
    ("offered", "now_s", "refusal"),
    [
        (command(0, episode="a"), 10.1, "wrong episode"),
        (command(0, episode="other"), 10.1, "wrong episode"),
        (command(0, source="expert"), 10.1, "not the driver"),
        (command(1), 10.1, "unknown frame"),
        (command(0), 10.46, "stale"),
        (command(0, speed=float("nan")), 10.1, "not finite"),
        (command(0, speed=float("inf")), 10.1, "not finite"),
        (command(0, speed=1.01), 10.1, "not finite"),
        (command(0, speed=1.5), 10.1, "not finite"),
        (command(0, speed=-0.01), 10.1, "not finite"),
    ],
)
def test_refusals_are_named_counted_and_harmless(
    gate: CommandGate, offered: Command, now_s: float, refusal: str
) -> None:
    assert gate.offer(offered, now_s) == refusal
    assert gate.refused == {refusal: 1}
    assert gate.applied(now_s) == STAND


def test_a_command_expires_after_its_last_moment_and_not_in_it() -> None:
    gate = armed(max_age_s=0.5)  # which floating point represents exactly
    gate.begin("e", "policy")
    gate.captured(0, 10.0)
    gate.captured(1, 10.5)
    assert gate.offer(command(0), 10.5) is None
    assert gate.applied(10.5).answered_tick == 0
    assert gate.applied(10.500001) == STAND
    assert gate.offer(command(0, sequence=1), 10.500001) == "stale"
    gate.captured(2, 10.6)
    assert gate.offer(command(0, sequence=1), 10.6) == "stale"


def test_a_gate_that_runs_for_long_stays_small(gate: CommandGate) -> None:
    def size() -> int:
        return len(pickle.dumps({name: value for name, value in vars(gate).items() if name != "_lock"}))

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


@pytest.mark.parametrize("episode", ["e", "x", "policy", "teleop"])
def test_nothing_moves_before_the_first_episode(episode: str) -> None:
    gate = armed()
    gate.captured(0, 10.0)
    for source in SOURCES[1:]:
        assert gate.offer(command(0, source=source, episode=episode), 10.0) == "wrong episode"
    assert gate.applied(10.0) == STAND
    assert gate.emergency_stop == 0


def test_out_of_order_and_repeated_commands_are_refused(gate: CommandGate) -> None:
    gate.captured(1, 10.1)
    assert gate.offer(command(1), 10.1) is None
    assert gate.offer(command(0, atom="left"), 10.1) == "out of order"
    assert gate.offer(command(1, atom="left"), 10.1) == "out of order"
    assert gate.offer(command(1, sequence=1, atom="left"), 10.1) is None
    assert gate.applied(10.1).atom == "left"


@pytest.mark.parametrize("driver", ["policy", "expert"])
def test_a_person_takes_over_and_the_robot_stands_until_the_driver_is_told_to_go_on(driver: Source) -> None:
    gate = armed()
    gate.begin("e", driver)
    gate.captured(0, 10.0)
    gate.offer(command(0, source=driver), 10.0)
    assert not gate.taken_over
    assert gate.offer(command(0, source="teleop", atom="left"), 10.0) is None
    assert gate.taken_over
    gate.captured(3, 10.1)
    assert gate.offer(command(3, source=driver), 10.1) is None, "what it would do is heard, for lockstep"
    assert gate.answered(3)
    assert gate.applied(10.2) == Applied("left", 1.0, "teleop", "command", answered_tick=0)
    # The link is lost, or the key let go: the driver does not go on by itself, however long that lasts.
    for now_s in (10.0 + MAX_AGE_S + 0.01, 11.0, 1000.0):
        gate.captured(round(now_s), now_s)
        gate.offer(command(round(now_s), source=driver), now_s)
        assert gate.applied(now_s) == Applied("stop", 0.0, None, "taken_over")
    assert gate.resume("e", 1000, "") is None
    assert not gate.taken_over
    assert gate.applied(1000.0) == STAND
    gate.captured(1001, 1000.1)
    gate.offer(command(1001, source=driver), 1000.1)
    assert gate.applied(1000.1).source == driver


def test_the_driver_goes_on_only_from_what_the_person_knew(gate: CommandGate) -> None:
    for tick in (1, 2):
        gate.captured(tick, 10.0)
        gate.offer(command(tick, source="teleop", atom="stop"), 10.0)
    said = "another episode has begun, or the person has commanded since"
    assert gate.resume("e", 1, "") == said
    for episode in ("another", "other"):
        assert gate.resume(episode, 2, "") == said
    assert gate.taken_over
    assert gate.resume("e", 2, "") is None
    assert not gate.taken_over


def test_where_no_episode_runs_nobody_has_to_know_the_last_one(gate: CommandGate) -> None:
    gate.offer(command(0, source="teleop"), 10.0)
    hear(gate, "o", 0, 10.0)
    assert gate.resume(None, 0, "another") == THEIRS
    assert gate.taken_over
    assert gate.resume(None, 0, "o") is None
    assert not gate.taken_over


@pytest.mark.parametrize("tick", [0, 99])
@pytest.mark.parametrize("episode", ["e", "other"])
def test_an_emergency_stop_holds_until_it_is_released(gate: CommandGate, tick: int, episode: str) -> None:
    gate.offer(command(0), 10.0)
    assert gate.offer(command(tick, source="emergency_stop", atom="forward", episode=episode), 99.0) is None
    gate.captured(1, 10.1)
    gate.offer(command(1), 10.1)
    assert gate.applied(10.1) == Applied("stop", 0.0, "emergency_stop", "emergency_stop")
    gate.begin("f", "policy")
    gate.captured(0, 10.2)
    assert gate.offer(command(0, episode="f"), 10.2) is None
    assert gate.applied(10.2).reason == "emergency_stop"
    assert (gate.emergency_stop, gate.stop_cause) == (2, "emergency_stop")
    assert gate.arm(2, "") is None
    assert (gate.emergency_stop, gate.stop_cause) == (0, None)


def test_a_robot_that_was_started_moves_for_nobody_until_it_is_armed() -> None:
    gate = CommandGate()
    assert gate.stop_cause == "not_armed"
    gate.begin("e", "policy")
    gate.captured(0, 10.0)
    assert gate.offer(command(0), 10.0) is None, "what it would do is heard"
    assert gate.applied(10.0) == Applied("stop", 0.0, None, "emergency_stop")
    assert gate.arm(gate.emergency_stop, "") is None
    assert gate.stop_cause is None


def test_no_stop_from_before_a_restart_is_released_after_it() -> None:
    numbers = {CommandGate().emergency_stop for _ in range(100)}
    assert len(numbers) == 100
    assert all(0 < number < 2**62 for number in numbers)
    assert all(abs(one - other) > 10 for one in numbers for other in numbers if one != other)


@pytest.mark.parametrize("number", [1, 2, 4, 0])
def test_a_stop_is_released_by_its_own_number_alone(gate: CommandGate, number: int) -> None:
    gate.stop()
    gate.stop()
    assert gate.arm(number, "") == "another stop was latched meanwhile"
    assert gate.emergency_stop == 3
    assert gate.arm(3, "") is None
    assert gate.emergency_stop == 0
    assert gate.arm(number, "") == "no stop is latched"
    # Released once: the number is not good for the next one.
    gate.stop()
    assert gate.arm(3, "") == "another stop was latched meanwhile"
    assert gate.emergency_stop == 4


@pytest.mark.parametrize("cause", ["emergency_stop", "operator_lost", "fault"])
def test_who_drove_before_a_stop_does_not_go_on_by_being_released(gate: CommandGate, cause: StopCause) -> None:
    gate.offer(command(0), 10.0)
    gate.stop(cause)
    assert gate.stop_cause == cause
    assert gate.applied(10.0).source == ("emergency_stop" if cause == "emergency_stop" else None)
    assert gate.arm(2, "") is None
    assert gate.taken_over
    assert gate.applied(10.0) == Applied("stop", 0.0, None, "taken_over")
    assert gate.resume("e", 0, "") is None
    gate.captured(1, 10.1)
    gate.offer(command(1), 10.1)
    assert gate.applied(10.1).source == "policy"


@pytest.mark.parametrize("other", ["operator_lost", "fault"])
def test_a_latched_emergency_stop_is_not_hidden_by_another_stop(gate: CommandGate, other: StopCause) -> None:
    gate.stop(other)
    gate.stop()
    assert gate.stop_cause == "emergency_stop"
    gate.stop(other)
    assert (gate.stop_cause, gate.emergency_stop) == ("emergency_stop", 4)
    assert gate.arm(4, "") is None
    gate.stop(other)
    assert gate.stop_cause == other


def test_of_two_stops_the_graver_cause_is_told_in_whatever_order_they_come() -> None:
    """Who only misses the operator would arm a robot whose body has failed, without a look at it."""
    for graver, other in (("fault", "operator_lost"), ("operator_lost", "not_armed"), ("emergency_stop", "fault")):
        for causes in ((graver, other), (other, graver)):
            gate = armed()
            for cause in causes:
                gate.stop(cause)
            assert gate.stop_cause == graver


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
def test_an_emergency_stop_of_the_same_instant_is_not_hidden_by_another_stop(how: str) -> None:
    gate = Interrupted(attended=True, first_stop=1)
    hear(gate, "o", 0, 10.0)
    if how == "stop":
        gate.stop("fault")
    elif how == "silence":
        gate.watch(11.0)
    else:
        hear(gate, "o", 1, 10.0, present=False)
    gate.other.join()
    assert (gate.stop_cause, gate.emergency_stop) == ("emergency_stop", 3)


def test_an_operator_who_falls_silent_is_missed(gate: CommandGate) -> None:
    hear(gate, "o", 0, 10.0)
    assert gate.operator == "o"
    gate.watch(10.25)
    assert gate.emergency_stop == 0
    hear(gate, "o", 1, 10.25)
    gate.watch(10.5)
    assert gate.operator == "o"
    gate.watch(10.5001)
    assert gate.operator is None
    assert (gate.emergency_stop, gate.stop_cause) == (2, "operator_lost")
    gate.watch(20.0)
    assert gate.emergency_stop == 2, "once"


@pytest.mark.parametrize("sequence", [0, 1])
def test_a_sign_of_life_that_comes_twice_or_late_is_none(gate: CommandGate, sequence: int) -> None:
    hear(gate, "o", 1, 10.0)
    hear(gate, "o", sequence, 10.2)
    gate.watch(10.1 + OPERATOR_S)
    assert gate.stop_cause == "operator_lost"


def test_an_operator_who_says_good_bye_is_not_missed(gate: CommandGate) -> None:
    hear(gate, "o", 0, 10.0)
    hear(gate, "o", 1, 10.1, present=False)
    assert (gate.operator, gate.not_theirs("p")) == (None, None)
    gate.watch(99.0)
    assert gate.emergency_stop == 0


@pytest.mark.parametrize("late", [0, 1])
def test_a_sign_of_life_from_before_the_good_bye_brings_nobody_back(gate: CommandGate, late: int) -> None:
    hear(gate, "o", 0, 10.0)
    hear(gate, "o", 1, 10.1, present=False)
    hear(gate, "o", late, 10.2)
    assert gate.operator is None
    gate.watch(99.0)
    assert gate.emergency_stop == 0
    hear(gate, "o", 2, 99.0)
    assert gate.operator == "o"


def test_one_who_was_lost_and_is_heard_again_is_the_operator_again(gate: CommandGate) -> None:
    hear(gate, "o", 3, 10.0)
    gate.watch(10.0 + 2 * OPERATOR_S)
    assert gate.operator is None
    hear(gate, "o", 3, 11.0)
    assert gate.operator is None
    hear(gate, "o", 4, 11.0)
    assert gate.operator == "o"


def test_an_operator_is_missed_by_the_age_of_what_they_answer(gate: CommandGate) -> None:
    pulse = gate.pulse(10.0)
    gate.hear(beat("o", 0, pulse), 10.2)
    gate.watch(10.25)
    assert gate.operator == "o"
    gate.watch(10.2501)
    assert gate.stop_cause == "operator_lost", "not 0.25 s after their answer was heard"


@pytest.mark.parametrize(("heard_s", "there"), [(10.25, True), (10.2501, False), (13.0, False)])
def test_an_answer_that_took_too_long_is_no_sign_of_life(gate: CommandGate, heard_s: float, there: bool) -> None:
    pulse = gate.pulse(10.0)
    gate.pulse(heard_s)
    gate.hear(beat("o", 0, pulse), heard_s)
    assert (gate.operator == "o") == there
    gate.watch(heard_s)
    assert gate.emergency_stop == 0, "nobody was there whom it could miss"


def test_by_a_link_that_grows_slow_an_operator_is_lost_however_steadily_they_answer(gate: CommandGate) -> None:
    """An answer comes every 0.06 s, and each is of an ever older moment: whoever gave it may be dead by now."""
    sent_s = [10.0 + 0.05 * k for k in range(300)]
    pulses, answers = sent_s.copy(), [(at + min(3.0, 0.01 * k), k) for k, at in enumerate(sent_s)]
    numbers, there_s = [], 0.0
    while answers:
        if pulses and pulses[0] <= answers[0][0]:
            now_s = pulses.pop(0)
            numbers.append(gate.pulse(now_s))
        else:
            now_s, k = answers.pop(0)
            gate.hear(beat("o", k, numbers[k]), now_s)
        gate.watch(now_s)
        if gate.operator is not None:
            there_s = now_s
    assert sent_s[20] < there_s <= sent_s[25] + OPERATOR_S, "the 26th answer took 0.26 s"
    assert gate.stop_cause == "operator_lost"


@pytest.mark.parametrize("off", [-1, 1, 7, None])
def test_what_answers_no_pulse_is_no_sign_of_life(gate: CommandGate, off: int | None) -> None:
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
    assert gate.emergency_stop == 2
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
    assert gate.arm(1, "o") == "no operator answers in time; this robot moves only while one does"
    hear(gate, "o", 0, 10.0)
    assert gate.arm(1, "x") == THEIRS
    assert gate.arm(1, "o") is None
    gate.begin("e", "policy")
    gate.captured(0, 10.0)
    gate.offer(command(0), 10.0)
    hear(gate, "o", 1, 10.05)
    assert gate.applied(10.0).atom == "forward"
    hear(gate, "o", 2, 10.1, present=False)
    assert (gate.emergency_stop, gate.stop_cause) == (2, "operator_lost")


def test_one_process_of_a_kind_commands_until_it_falls_silent(gate: CommandGate) -> None:
    for tick in (1, 2, 3):
        gate.captured(tick, 10.0)
    assert gate.offer(command(1, session="a", sequence=1_000_000), 10.0) is None
    for other in ("0", "b"):
        assert gate.offer(command(2, session=other, atom="left"), 10.0) == "another session"
    assert gate.applied(10.0).atom == "forward"
    assert gate.offer(command(2, session="a"), 10.0) is None, "no number locks the rightful sender out"
    late_s = 11.0
    gate.captured(12, late_s)
    assert gate.offer(command(12, session="b"), late_s) == "another session"
    gate.captured(13, late_s + 0.001)
    assert gate.offer(command(13, session="b"), late_s + 0.001) is None
    assert gate.offer(command(13, session="a", sequence=9), late_s + 0.001) == "another session"
    assert gate.applied(late_s + 0.001).answered_tick == 13


@pytest.mark.parametrize(("first", "second"), ["ab", "ba"])
def test_the_order_of_another_process_is_its_own(gate: CommandGate, first: str, second: str) -> None:
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


SESSIONS = st.sampled_from(["", "o", "p"])


class GateMachine(RuleBasedStateMachine):
    """Against a model that keeps everything that was said for ever, and picks by definition."""

    @initialize(driver=st.sampled_from(SOURCES[1:]), attended=st.booleans())
    def start(self, driver: Source, attended: bool) -> None:
        self.attended = attended
        self.now = 0.0
        self.restart()
        self.next_episode(driver)

    @rule()
    def restart(self) -> None:
        """Kill the process and start it again."""
        self.gate = CommandGate(attended=self.attended)
        self.stop = self.gate.emergency_stop
        self.emergency = False
        self.operator: str | None = None
        self.answered_s = -math.inf
        self.pulses = [(7, -math.inf)]
        self.beats = getattr(self, "beats", 0)
        self.last_beat = ("none", -1)
        self.forget("none", "policy")

    def forget(self, episode: str, driver: Source) -> None:
        self.episode, self.driver = episode, driver
        self.taken_over = False
        self.tick = 0
        self.captured: dict[int, float] = {}
        self.accepted: list[tuple[Command, float]] = []
        self.leased: dict[str, tuple[str, float]] = {}
        self.expired = 0

    @rule(step=st.sampled_from([0.01, 0.1, 0.2, 0.3, 2.0]))
    def wait(self, step: float) -> None:
        self.now += step
        self.gate.watch(self.now)
        if self.operator is not None and self.now - self.answered_s > OPERATOR_S:
            self.operator = None
            self.latched("operator_lost")

    def latched(self, cause: StopCause) -> None:
        assert self.gate.emergency_stop not in (0, self.stop), "every stop has a number of its own"
        self.emergency = cause == "emergency_stop" or (self.stop != 0 and self.emergency)
        assert self.gate.stop_cause == ("emergency_stop" if self.emergency else cause)
        self.stop = self.gate.emergency_stop

    @rule()
    def frame(self) -> None:
        self.tick += 1
        self.captured[self.tick] = self.now
        self.gate.captured(self.tick, self.now)

    @rule()
    def pulse(self) -> None:
        self.pulses.append((self.gate.pulse(self.now), self.now))

    @rule(
        session=SESSIONS,
        present=st.sampled_from([True, True, True, False]),
        again=st.booleans(),
        back=st.sampled_from([0, 0, 1, 2, 9]),
    )
    def hear(self, session: str, present: bool, again: bool, back: int) -> None:
        self.beats += not again
        number, sent_s = self.pulses[max(-1 - back, -len(self.pulses))]
        self.gate.hear(beat(session, self.beats, number, present=present), self.now)
        if self.now - sent_s > OPERATOR_S:
            return  # it tells of long ago
        if self.last_beat == (session, self.beats) or self.operator not in (None, session):
            return  # it was heard before, or somebody else is there
        left = self.operator is not None and not present
        known_s = self.answered_s if self.last_beat[0] == session else -math.inf
        self.operator, self.answered_s = session if present else None, max(known_s, sent_s)
        self.last_beat = session, self.beats
        if left and self.attended:
            self.latched("operator_lost")

    @rule(cause=st.sampled_from(["emergency_stop", "fault"]))
    def latch(self, cause: StopCause) -> None:
        self.gate.stop(cause)
        self.latched(cause)

    @rule(session=SESSIONS, off=st.sampled_from([0, 0, 0, 1, -1]))
    def arm(self, session: str, off: int) -> None:
        may = self.operator == session or (self.operator is None and not self.attended)
        done = self.gate.arm((self.stop or 7) + off, session) is None
        assert done == (may and self.stop != 0 and off == 0)
        if done:
            self.stop = 0
            self.taken_over = self.episode != "none"
            self.expired = len(self.accepted)

    @rule(back=st.integers(0, 2), episode=st.sampled_from(["e", "e", "old"]), session=SESSIONS)
    def resume(self, back: int, episode: str, session: str) -> None:
        tick = max(0, self.tick - back)
        mine = [c.tick for c, _ in self.accepted if c.source == "teleop"][-1:]
        resumed = self.gate.resume(episode, tick, session) is None
        assert resumed == (
            episode == self.episode and max(mine, default=0) <= tick and self.operator in (None, session)
        )
        if resumed:
            self.taken_over = False
            self.expired = len(self.accepted)

    @rule(driver=st.sampled_from(SOURCES[1:]))
    def next_episode(self, driver: Source) -> None:
        self.gate.begin("e", driver)
        self.forget("e", driver)
        self.captured = {0: self.now}
        self.gate.captured(0, self.now)

    @rule(
        source=st.sampled_from(SOURCES),
        session=SESSIONS,
        back=st.integers(-1, 6),
        sequence=st.integers(0, 2),
        atom=st.sampled_from(["forward", "left", "stop"]),
        episode=st.sampled_from(["e", "e", "e", "old"]),
    )
    def offer(self, source: Source, session: str, back: int, sequence: int, atom: Atom, episode: str) -> None:
        offered = command(
            max(0, self.tick - back), sequence=sequence, source=source, atom=atom, episode=episode, session=session
        )
        refusal = self.gate.offer(offered, self.now)
        if source == "emergency_stop":
            assert refusal is None
            self.latched("emergency_stop")
            return
        holder, held_s = self.leased.get(source, (session, 0.0))
        last = [c for c, _ in self.accepted if c.source == source and c.session == session == holder][-1:]
        may = (
            offered.episode == self.episode
            and source in ("teleop", self.driver)
            and (source != "teleop" or self.operator in (None, session))
            and (holder == session or self.now - held_s > LEASE_S)
            and all((c.tick, c.sequence) < (offered.tick, sequence) for c in last)
            and self.now - self.captured.get(offered.tick, -math.inf) <= MAX_AGE_S
        )
        assert (refusal is None) == may, refusal
        if may:
            self.leased[source] = (session, self.now)
            self.accepted.append((offered, self.now))
            self.taken_over |= source != self.driver

    @invariant()
    def only_the_last_accepted_fresh_command_of_whoever_drives_moves_the_robot(self) -> None:
        if not hasattr(self, "gate"):
            return
        applied = self.gate.applied(self.now)
        who = "teleop" if self.taken_over else self.driver
        theirs = [c for c, _ in self.accepted[self.expired :] if c.source == who][-1:]
        fresh = [c for c in theirs if self.now - self.captured[c.tick] <= MAX_AGE_S]
        assert (self.gate.taken_over, self.gate.operator) == (self.taken_over, self.operator)
        assert self.gate.emergency_stop == self.stop
        if self.stop:
            assert (applied.atom, applied.speed, applied.reason) == ("stop", 0.0, "emergency_stop")
        elif not fresh:
            assert applied == Applied("stop", 0.0, None, "taken_over" if self.taken_over else "silence")
        else:
            assert applied == Applied(fresh[0].atom, fresh[0].speed, who, "command", fresh[0].tick)
        if applied.atom != "stop":
            assert not self.attended or self.operator is not None

    @invariant()
    def commands_of_one_process_are_in_order(self) -> None:
        if not hasattr(self, "gate"):
            return
        for (one, _), (other, _) in pairwise([pair for pair in self.accepted if pair[0].source == self.driver]):
            assert one.session != other.session or (one.tick, one.sequence) < (other.tick, other.sequence)

    @invariant()
    def a_frame_is_answered_when_the_newest_command_of_the_driver_is_for_it(self) -> None:
        if not hasattr(self, "gate"):
            return
        mine = [c.tick for c, _ in self.accepted if c.source == self.driver]
        assert self.gate.answered(self.tick) == (mine[-1:] == [self.tick])


GateMachine.TestCase.settings = settings(max_examples=150, stateful_step_count=40, deadline=None)
TestGateMachine: Callable[[], object] = GateMachine.TestCase

"""The command gate: nothing moves the robot unless it is fresh, finite, in order and from the highest source."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from dataclasses import FrozenInstanceError

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule

from schemas.base import SOURCES, Atom, Source
from schemas.command import Command
from services.robot.gate import MAX_AGE_S, Applied, CommandGate

STAND = Applied("stop", 0.0, None, "silence")


def command(
    tick: int,
    *,
    sequence: int = 0,
    source: Source = "policy",
    atom: Atom = "forward",
    episode: str = "e",
    speed: float = 1.0,
) -> Command:
    header = {"robot": "r", "episode": episode, "tick": tick, "stamp_ns": 0}
    whole = Command(**header, source=source, sequence=sequence, atom=atom)
    # The schema would refuse what the gate has to refuse by itself.
    return whole.model_copy(update={"speed": speed})


@pytest.fixture
def gate() -> CommandGate:
    gate = CommandGate()
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


def test_refusals_add_up_until_the_next_episode(gate: CommandGate) -> None:
    for _ in range(3):
        gate.offer(command(1), 10.1)
    assert gate.refused == {"unknown frame": 3}
    gate.begin("f", "policy")
    assert gate.refused == {}


@pytest.mark.parametrize("speed", [0.0, 0.5, 1.0])
def test_speed_is_passed_on(gate: CommandGate, speed: float) -> None:
    assert gate.offer(command(0, speed=speed), 10.0) is None
    assert gate.applied(10.0).speed == speed


def test_a_command_expires_after_its_last_moment_and_not_in_it() -> None:
    gate = CommandGate(max_age_s=0.5)  # which floating point represents exactly
    gate.begin("e", "policy")
    gate.captured(0, 10.0)
    gate.captured(1, 10.5)
    assert gate.offer(command(0), 10.5) is None
    assert gate.applied(10.5).answered_tick == 0
    assert gate.applied(10.500001) == STAND
    assert gate.offer(command(0, sequence=1), 10.500001) == "stale"
    gate.captured(2, 10.6)
    assert gate.offer(command(0, sequence=1), 10.6) == "stale"


def test_the_frame_before_the_last_may_still_be_answered(gate: CommandGate) -> None:
    gate.captured(1, 10.1)
    gate.captured(2, 10.2)
    assert gate.offer(command(1), 10.25) is None
    assert gate.applied(10.25).answered_tick == 1


def test_a_frame_that_was_dropped_is_unknown_and_not_stale(gate: CommandGate) -> None:
    gate.captured(2, 10.2)
    assert gate.offer(command(1), 10.2) == "unknown frame"


def test_a_gate_that_runs_for_long_stays_small(gate: CommandGate) -> None:
    def size() -> int:
        return len(pickle.dumps(gate))

    for tick in range(10):
        gate.captured(tick, 10.0 + 0.1 * tick)
        gate.offer(command(tick), 10.0 + 0.1 * tick)
    after_a_second = size()
    for tick in range(10, 1000):
        gate.captured(tick, 10.0 + 0.1 * tick)
    gate.offer(command(999), 10.0 + 0.1 * 999)
    assert size() < after_a_second + 100


def test_no_frame_is_known_before_the_first(gate: CommandGate) -> None:
    gate.begin("f", "policy")
    assert gate.offer(command(0, episode="f"), 10.0) == "unknown frame"


@pytest.mark.parametrize("episode", ["e", "x", "policy", "teleop"])
def test_nothing_moves_before_the_first_episode(episode: str) -> None:
    gate = CommandGate()
    gate.captured(0, 10.0)
    for source in SOURCES[1:]:
        assert gate.offer(command(0, source=source, episode=episode), 10.0) == "wrong episode"
    assert gate.applied(10.0) == STAND
    assert gate.emergency_stop == 0


def test_what_is_applied_cannot_be_changed(gate: CommandGate) -> None:
    with pytest.raises(FrozenInstanceError):
        gate.applied(10.0).atom = "forward"  # type: ignore[misc]


def test_frozen_sender_that_wakes_with_an_old_plan_is_stale(gate: CommandGate) -> None:
    for tick in range(1, 100):
        gate.captured(tick, 10.0 + 0.1 * tick)
    assert gate.offer(command(50), 19.9) == "stale"


def test_out_of_order_and_repeated_commands_are_refused(gate: CommandGate) -> None:
    gate.captured(1, 10.1)
    assert gate.offer(command(1), 10.1) is None
    assert gate.offer(command(0, atom="left"), 10.1) == "out of order"
    assert gate.offer(command(1, atom="left"), 10.1) == "out of order"
    assert gate.offer(command(1, sequence=1, atom="left"), 10.1) is None
    assert gate.applied(10.1).atom == "left"


def test_order_is_that_of_the_frames_first(gate: CommandGate) -> None:
    for tick in (2, 3):
        gate.captured(tick, 10.0)
    assert gate.offer(command(2), 10.0) is None
    assert gate.offer(command(3), 10.0) is None
    assert gate.offer(command(2, sequence=5), 10.0) == "out of order"


@pytest.mark.parametrize(("driver", "other"), [("expert", "policy"), ("policy", "expert"), ("teleop", "policy")])
def test_no_other_program_than_the_driver_moves_the_robot(driver: Source, other: Source) -> None:
    gate = CommandGate()
    gate.begin("e", driver)
    gate.captured(0, 0.0)
    assert gate.offer(command(0, source=other), 0.0) == "not the driver"
    assert gate.offer(command(0, source=driver), 0.0) is None
    assert gate.applied(0.1).source == driver


def test_a_person_goes_before_every_driver() -> None:
    gate = CommandGate()
    gate.begin("e", "expert")
    gate.captured(0, 0.0)
    gate.offer(command(0, source="expert"), 0.0)
    assert gate.offer(command(0, source="teleop", atom="left"), 0.0) is None
    assert gate.applied(0.1).source == "teleop"


@pytest.mark.parametrize("driver", ["policy", "expert"])
def test_a_person_takes_over_and_the_robot_stands_until_the_driver_is_told_to_go_on(driver: Source) -> None:
    gate = CommandGate()
    gate.begin("e", driver)
    gate.captured(0, 10.0)
    gate.offer(command(0, source=driver), 10.0)
    assert not gate.taken_over
    assert gate.offer(command(0, source="teleop", atom="left"), 10.0) is None
    assert gate.taken_over
    gate.captured(3, 10.1)
    assert gate.offer(command(3, source=driver), 10.1) is None, "what it would do is heard, for lockstep"
    assert gate.answered(driver, 3)
    assert gate.applied(10.2) == Applied("left", 1.0, "teleop", "command", answered_tick=0)
    # The link is lost, or the key let go: the driver does not go on by itself, however long that lasts.
    for now_s in (10.0 + MAX_AGE_S + 0.01, 11.0, 1000.0):
        gate.captured(round(now_s), now_s)
        gate.offer(command(round(now_s), source=driver), now_s)
        assert gate.applied(now_s) == Applied("stop", 0.0, None, "taken_over")
    assert gate.resume("e", 1000)
    assert not gate.taken_over
    assert gate.applied(1000.0) == STAND
    gate.captured(1001, 1000.1)
    gate.offer(command(1001, source=driver), 1000.1)
    assert gate.applied(1000.1).source == driver


def test_what_a_person_asked_for_before_the_driver_goes_on_no_longer_counts(gate: CommandGate) -> None:
    gate.offer(command(0, source="teleop", atom="left"), 10.0)
    assert gate.resume("e", 0)
    assert gate.applied(10.0) == STAND
    assert gate.offer(command(0, source="teleop", atom="left"), 10.0) == "out of order"
    assert gate.offer(command(0, sequence=1, source="teleop"), 10.0) is None, "a key that is pressed again does"
    assert gate.applied(10.0).source == "teleop"


def test_the_driver_goes_on_only_from_what_the_person_knew(gate: CommandGate) -> None:
    for tick in (1, 2):
        gate.captured(tick, 10.0)
        gate.offer(command(tick, source="teleop", atom="stop"), 10.0)
    assert gate.resume("e", 1) is False, "they have commanded since they asked"
    for episode in ("another", "other"):
        assert gate.resume(episode, 2) is False
    assert gate.taken_over
    assert gate.resume("e", 2)
    assert not gate.taken_over


def test_a_person_who_drives_takes_over_from_nobody() -> None:
    gate = CommandGate()
    gate.begin("e", "teleop")
    gate.captured(0, 10.0)
    gate.offer(command(0, source="teleop"), 10.0)
    assert not gate.taken_over
    assert gate.applied(11.0) == STAND


def test_the_next_episode_is_its_drivers(gate: CommandGate) -> None:
    gate.offer(command(0, source="teleop"), 10.0)
    gate.begin("f", "policy")
    assert not gate.taken_over
    gate.captured(0, 10.0)
    gate.offer(command(0, episode="f"), 10.0)
    assert gate.applied(10.0).source == "policy"


def test_going_on_begins_with_a_new_command(gate: CommandGate) -> None:
    gate.offer(command(0), 10.0)
    assert gate.resume("e", 0)
    assert gate.applied(10.0) == STAND
    assert gate.offer(command(0), 10.0) == "out of order", "a message that comes twice is none"
    gate.captured(1, 10.1)
    assert gate.offer(command(1), 10.1) is None
    assert gate.applied(10.1).source == "policy"


@pytest.mark.parametrize("tick", [0, 99])
@pytest.mark.parametrize("episode", ["e", "other"])
def test_emergency_stop_holds_until_an_episode_that_releases_it(gate: CommandGate, tick: int, episode: str) -> None:
    gate.offer(command(0), 10.0)
    assert gate.offer(command(tick, source="emergency_stop", atom="forward", episode=episode), 99.0) is None
    gate.captured(1, 10.1)
    gate.offer(command(1), 10.1)
    assert gate.applied(10.1) == Applied("stop", 0.0, "emergency_stop", "emergency_stop")
    gate.begin("f", "policy")
    gate.captured(0, 10.2)
    assert gate.offer(command(0, episode="f"), 10.2) is None
    assert gate.applied(10.2).reason == "emergency_stop"
    assert gate.emergency_stop == 1
    gate.begin("g", "policy", release_stop=1)
    assert gate.emergency_stop == 0
    assert gate.applied(10.2) == STAND


@pytest.mark.parametrize("released", [0, 1, 3])
def test_a_stop_is_released_by_its_own_number_alone(gate: CommandGate, released: int) -> None:
    gate.stop()
    gate.stop()
    gate.begin("f", "policy", release_stop=released)
    assert gate.emergency_stop == 2
    gate.begin("g", "policy", release_stop=2)
    assert gate.emergency_stop == 0
    # Released once: the number is not good for the next one.
    gate.stop()
    gate.begin("h", "policy", release_stop=2)
    assert gate.emergency_stop == 3
    assert gate.applied(10.0).reason == "emergency_stop"


def test_nothing_is_released_where_no_stop_is_latched(gate: CommandGate) -> None:
    gate.begin("f", "policy", release_stop=1)
    assert gate.emergency_stop == 0
    gate.stop()
    assert gate.emergency_stop == 1


def test_emergency_stop_before_the_first_episode_holds() -> None:
    gate = CommandGate()
    assert gate.offer(command(0, source="emergency_stop"), 0.0) is None
    gate.begin("e", "policy")
    assert gate.applied(0.0).reason == "emergency_stop"


def test_what_is_applied_names_the_frame_that_was_answered(gate: CommandGate) -> None:
    gate.offer(command(0), 10.0)
    gate.captured(1, 10.1)
    assert gate.applied(10.1).answered_tick == 0
    gate.offer(command(1), 10.15)
    assert gate.applied(10.2).answered_tick == 1
    assert gate.applied(11.0).answered_tick is None


def test_a_frame_is_answered_by_a_command_for_it(gate: CommandGate) -> None:
    for tick in (1, 2):
        gate.captured(tick, 10.0)
    assert not gate.answered("policy", 1)
    gate.offer(command(1), 10.0)
    assert [gate.answered("policy", tick) for tick in (0, 1, 2)] == [False, True, False]
    assert not gate.answered("teleop", 1)
    gate.offer(command(0, source="emergency_stop"), 10.0)
    assert not gate.answered("emergency_stop", 0)


class GateMachine(RuleBasedStateMachine):
    """Against a model that keeps every command for ever and picks by definition."""

    @initialize(driver=st.sampled_from(SOURCES[1:]))
    def begin(self, driver: Source) -> None:
        self.gate = CommandGate()
        self.gate.begin("e", driver)
        self.driver = driver
        self.now = 0.0
        self.tick = 0
        self.captured = {0: 0.0}
        self.gate.captured(0, 0.0)
        self.accepted: list[tuple[Command, float]] = []
        self.expired = 0
        self.stops = self.released = 0
        self.taken_over = False

    @rule(step=st.sampled_from([0.01, 0.1, 0.3, 2.0]))
    def wait(self, step: float) -> None:
        self.now += step

    @rule()
    def frame(self) -> None:
        self.tick += 1
        self.captured[self.tick] = self.now
        self.gate.captured(self.tick, self.now)

    @rule(back=st.integers(0, 2), episode=st.sampled_from(["e", "e", "old"]))
    def resume(self, back: int, episode: str) -> None:
        tick = max(0, self.tick - back)
        mine = [c.tick for c, _ in self.accepted if c.source == "teleop"]
        resumed = self.gate.resume(episode, tick)
        assert resumed == (episode == "e" and max(mine, default=0) <= tick)
        if resumed:
            self.taken_over = False
            self.expired = len(self.accepted)

    @rule(release=st.integers(0, 3), driver=st.sampled_from(SOURCES[1:]))
    def next_episode(self, release: int, driver: Source) -> None:
        self.driver = driver
        self.gate.begin("e", self.driver, release_stop=release)
        self.taken_over = False
        self.tick = 0
        self.captured = {0: self.now}
        self.gate.captured(0, self.now)
        self.accepted.clear()
        self.expired = 0
        self.released = self.stops if release == self.stops else self.released

    @rule(
        source=st.sampled_from(SOURCES),
        back=st.integers(-1, 6),
        sequence=st.integers(0, 2),
        atom=st.sampled_from(["forward", "left", "stop"]),
        episode=st.sampled_from(["e", "e", "e", "old"]),
    )
    def offer(self, source: Source, back: int, sequence: int, atom: Atom, episode: str) -> None:
        offered = command(max(0, self.tick - back), sequence=sequence, source=source, atom=atom, episode=episode)
        refusal = self.gate.offer(offered, self.now)
        if source == "emergency_stop":
            self.stops += 1
            assert refusal is None
        elif refusal is None:
            self.accepted.append((offered, self.now))
            assert offered.episode == "e"
            assert source in ("teleop", self.driver)
            self.taken_over |= source != self.driver
            assert self.now - self.captured[offered.tick] <= MAX_AGE_S

    @invariant()
    def only_the_newest_fresh_command_of_whoever_drives_moves_the_robot(self) -> None:
        if not hasattr(self, "gate"):
            return
        applied = self.gate.applied(self.now)
        who = "teleop" if self.taken_over else self.driver
        fresh = [
            c
            for c, _ in self.accepted[self.expired :]
            if c.source == who and self.now - self.captured[c.tick] <= MAX_AGE_S
        ]
        assert self.gate.taken_over == self.taken_over
        if self.stops != self.released:
            assert applied == Applied("stop", 0.0, "emergency_stop", "emergency_stop")
        elif not fresh:
            assert applied == Applied("stop", 0.0, None, "taken_over" if self.taken_over else "silence")
        else:
            newest = max(fresh, key=lambda c: (c.tick, c.sequence))
            assert applied == Applied(newest.atom, newest.speed, who, "command", newest.tick)

    @invariant()
    def a_frame_is_answered_when_the_newest_command_of_the_driver_is_for_it(self) -> None:
        if not hasattr(self, "gate"):
            return
        mine = [c.tick for c, _ in self.accepted if c.source == self.driver]
        assert self.gate.answered(self.driver, self.tick) == (mine[-1:] == [self.tick])


GateMachine.TestCase.settings = settings(max_examples=100, stateful_step_count=30, deadline=None)
TestGateMachine: Callable[[], object] = GateMachine.TestCase

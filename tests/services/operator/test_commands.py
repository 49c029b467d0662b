"""Keys and heartbeats become commands, without a terminal and without a bus."""

import math
from typing import cast

import pytest
from hypothesis import given
from hypothesis import strategies as st

from schemas.base import KEYS, STANDING, Velocity
from schemas.command import Command, CommandApplied
from schemas.episode import Episode
from services.operator.commands import Commands
from services.robot.body import Kinematics
from services.robot.gate import CommandGate, bounded


class Operator:
    """A teleoperation whose clock stands still until it is turned."""

    def __init__(self) -> None:
        self.now_s = 0.0
        self.service = Commands("r", lambda: self.now_s)

    def beat(
        self, tick: int, reason: str = "silence", episode: str = "e", stop: int = 7
    ) -> tuple[str, str, int, int] | None:
        source = {"silence": None, "latched_stop": "emergency_stop"}.get(reason, "teleop")
        return brief(self.service.handle(applied(tick, reason, source, episode, stop)))


def applied(
    tick: int, reason: str = "silence", source: str | None = None, episode: str = "e", stop: int = 7
) -> CommandApplied:
    """Return a heartbeat; stop is the number of the stop that is latched, if one is."""
    return CommandApplied.model_validate(
        {"robot": "r", "episode": episode, "tick": tick, "stamp_ns": tick, "atom": "stop"}
        | {"linear": 0.0, "angular": 0.0, "source": source, "reason": reason}
        | (
            {"latched_stop": stop, "stop_cause": "emergency_stop"}
            if reason == "latched_stop"
            else {}
        )
    )


def event(name: str, episode: str = "e", outcome: str | None = None) -> Episode:
    return Episode.model_validate(
        {
            "robot": "r", "episode": episode, "tick": 0, "stamp_ns": 0, "event": name,
            "purpose": "drive",
        }
        | {"driver": "teleop", "world": "yard", "seed": 1, "outcome": outcome}
    )  # fmt: skip


def brief(command: Command | None) -> tuple[str, str, int, int] | None:
    return (
        None if command is None else (command.source, command.atom, command.tick, command.sequence)
    )


@pytest.fixture
def operator() -> Operator:
    return Operator()


def test_a_press_is_sent_at_once_and_then_with_every_heartbeat(operator: Operator) -> None:
    operator.beat(3)
    assert brief(operator.service.hold(KEYS["forward"], math.inf)) == ("teleop", "forward", 3, 0)
    assert operator.beat(4) == ("teleop", "forward", 4, 0)
    assert operator.beat(5) == ("teleop", "forward", 5, 0)


def test_turn_key_drives_a_car_in_a_bend(
    operator: Operator,
) -> None:
    car = Kinematics(speed_m_s=1.0, turn_rate_rad_s=1.0, radius_m=2.0)

    def asked(command: Command | None) -> Velocity:
        return command.velocity

    operator.beat(3)
    on_the_spot = asked(operator.service.hold(KEYS["left"], math.inf))
    may, reason = bounded(on_the_spot, car, None, 0.0)
    assert (on_the_spot, may, reason) == (KEYS["left"], STANDING, "radius")
    bend = asked(operator.service.handle(applied(4, reason, "teleop")))
    assert bounded(bend, car, None, 0.0)[0] == (0.5, 0.25), "slowly, as narrow as two metres"
    assert asked(operator.service.hold(KEYS["backward"], math.inf)) == KEYS["backward"]
    assert asked(operator.service.hold(None)) == STANDING
    assert asked(operator.service.hold(KEYS["right"], math.inf)) == (0.5, -1.0), "it knows by now"
    assert asked(operator.service.hold(Velocity(1.0, 1.0), math.inf)) == (1.0, 1.0), (
        "it drives on as well"
    )
    assert asked(operator.service.hold(Velocity(0.0, 0.2), math.inf)) == (0.1, 0.2), (
        "a stick that turns a little"
    )
    operator.service.handle(applied(5, "radius", "teleop"))
    operator.service.on_event(event("started", "another"))
    operator.beat(0, episode="another")
    assert asked(operator.service.hold(KEYS["left"], math.inf)) == KEYS["left"], (
        "the next one may be another robot"
    )


def test_keys_without_a_robot_are_not_kept_for_one(operator: Operator) -> None:
    assert operator.service.hold(KEYS["forward"], math.inf) is None
    assert [operator.beat(tick) for tick in range(5)] == [None] * 5


def test_arming_releases_the_stop_that_the_robot_reported(operator: Operator) -> None:
    assert operator.service.to_release is None, "nothing was heard yet"
    operator.service.told(4)
    assert operator.service.to_release == 4
    operator.beat(0)
    assert operator.service.to_release == 0
    operator.service.stop_for_emergency()
    assert operator.service.to_release is None, "the robot has not told its number yet"
    operator.beat(1, "latched_stop", stop=9)
    assert operator.service.to_release == 9


steps = st.one_of(
    st.tuples(st.just("press"), st.tuples(st.floats(-1, 1), st.floats(-1, 1))),
    st.tuples(st.just("wait"), st.floats(0, 1)),
    st.tuples(st.just("beat"), st.none()),
    st.tuples(st.just("release"), st.none()),
    st.tuples(st.just("emergency"), st.none()),
)


@given(st.lists(steps, max_size=60))
def test_commands_are_in_order_and_end_with_a_stop(
    script: list[tuple[str, object]],
) -> None:
    operator = Operator()
    sent = []
    tick = 0
    for kind, value in script:
        if kind == "press":
            sent.append(brief(operator.service.hold(Velocity(*value), operator.now_s + 0.6)))
        elif kind == "wait":
            operator.now_s += value
            sent.append(brief(operator.service.poll()))
        elif kind == "release":
            sent.append(brief(operator.service.hold(None)))
        elif kind == "beat":
            tick += 1
            sent.append(operator.beat(tick))
        else:
            sent.append(brief(operator.service.stop_for_emergency()))
    operator.now_s += 10.0
    sent.append(brief(operator.service.poll()))
    said = [command for command in sent if command is not None]
    for source in ("teleop", "emergency_stop"):
        order = [(tick, sequence) for of, _, tick, sequence in said if of == source]
        assert order == sorted(set(order)), "the actuator refuses anything else"
    if said:
        assert said[-1][1] == "stop"


@given(
    st.lists(
        st.sampled_from(["e", "heartbeat", "lost", "n", "armed", "refused"]),
        min_size=20,
        max_size=60,
    )
)
def test_stop_is_released_only_by_a_later_key(
    script: list[str],
) -> None:
    operator = Operator()
    gate = CommandGate(first_stop=1)
    gate.arm(1, "")
    held = False
    asked = None
    since = False
    tick = 0
    for step in script:
        if step in ("e", "lost"):
            operator.service.stop_for_emergency()
            held = since = True
            if step == "e":
                gate.stop()
        elif step == "heartbeat":
            tick += 1
            stop = gate.latched_stop
            repeated = operator.beat(tick, "latched_stop" if stop else "silence", stop=stop)
            assert (repeated is not None) == (held and not stop and (asked is None or since))
            if repeated is not None:
                gate.stop()
        elif step == "n" and asked is None and operator.service.to_release is not None:
            asked = operator.service.to_release
            since = False
            operator.service.arming()
        elif step in ("armed", "refused") and asked is not None:
            if asked and step == "armed" and gate.arm(asked, "") is None:
                operator.service.armed()
                held = held and since
            operator.service.answered()
            asked = None
        assert operator.service.emergency == held


def test_operator_insists_when_they_hold_again_at_an_obstacle(
    operator: Operator,
) -> None:
    def hold(velocity: Velocity | None) -> bool:
        command = operator.service.hold(velocity, math.inf)
        return command is not None and command.insists

    def stand(tick: int, seconds: float) -> None:
        for part in range(11):
            assert not cast(
                "Command", operator.service.handle(applied(tick + part, "obstacle", "teleop"))
            ).insists
            operator.now_s += seconds / 10

    operator.beat(0)
    assert not hold(KEYS["forward"])
    stand(1, 0.5)
    assert not hold(None)
    assert not hold(KEYS["forward"]), "it stood too short a time for a person to have seen it"
    stand(20, 1.5)
    assert not hold(None)
    operator.now_s += 1.0
    assert hold(KEYS["forward"])
    going_on = operator.service.handle(applied(40, "insisted", "teleop"))
    assert going_on.insists
    assert not hold(None)
    assert not hold(KEYS["forward"]), "the next hold is one like any other"
    stand(50, 1.5)
    hold(None)
    operator.now_s += 3.0
    assert not hold(KEYS["forward"]), "that was long ago"

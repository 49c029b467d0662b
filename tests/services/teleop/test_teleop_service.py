"""What keys and heartbeats make of each other, without a terminal and without a bus."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from schemas.command import Command, CommandApplied
from schemas.episode import Episode
from services.teleop.keys import FIRST_HOLD_S, KeyHold
from services.teleop.service import TeleopService
from services.teleop.status import Status


class Operator:
    """A teleoperation whose clock stands still until it is turned."""

    def __init__(self) -> None:
        self.now_s = 0.0
        self.service = TeleopService(KeyHold(lambda: self.now_s), "r")

    def beat(self, tick: int, reason: str = "silence", episode: str = "e") -> tuple[str, str, int, int] | None:
        source = {"silence": None, "emergency_stop": "emergency_stop", "command": "teleop"}[reason]
        return brief(self.service.handle(applied(tick, reason, source, episode)))


def applied(tick: int, reason: str = "silence", source: str | None = None, episode: str = "e") -> CommandApplied:
    return CommandApplied.model_validate(
        {"robot": "r", "episode": episode, "tick": tick, "stamp_ns": tick, "atom": "stop", "speed": 1.0}
        | {"source": source, "reason": reason}
    )


def event(name: str, episode: str = "e", outcome: str | None = None) -> Episode:
    return Episode.model_validate(
        {"robot": "r", "episode": episode, "tick": 0, "stamp_ns": 0, "event": name, "purpose": "drive"}
        | {"driver": "teleop", "world": "yard", "seed": 1, "outcome": outcome}
    )


def brief(command: Command | None) -> tuple[str, str, int, int] | None:
    return None if command is None else (command.source, command.atom, command.tick, command.sequence)


@pytest.fixture
def operator() -> Operator:
    return Operator()


def test_nothing_is_said_while_no_key_is_held(operator: Operator) -> None:
    assert [operator.beat(tick) for tick in range(5)] == [None] * 5
    assert operator.service.poll() is None


def test_a_press_is_sent_at_once_and_then_with_every_heartbeat(operator: Operator) -> None:
    operator.beat(3)
    assert brief(operator.service.press("forward")) == ("teleop", "forward", 3, 0)
    assert operator.beat(4) == ("teleop", "forward", 4, 0)
    assert operator.beat(5) == ("teleop", "forward", 5, 0)


def test_a_tick_is_answered_once(operator: Operator) -> None:
    """The robot says at once, for the same frame, that it has changed its movement; that needs no answer."""
    operator.beat(3)
    operator.service.press("forward")
    assert operator.beat(3, "command") is None


def test_a_command_descends_from_the_heartbeat(operator: Operator) -> None:
    operator.service.handle(applied(8, episode="drive-1"))
    command = operator.service.press("left")
    assert command is not None
    assert (command.robot, command.episode, command.stamp_ns) == ("r", "drive-1", 8)


def test_a_release_is_one_stop_at_once_then_silence(operator: Operator) -> None:
    operator.beat(3)
    operator.service.press("forward")
    assert operator.beat(4) == ("teleop", "forward", 4, 0)
    operator.now_s = FIRST_HOLD_S
    assert brief(operator.service.poll()) == ("teleop", "stop", 4, 1)
    assert operator.service.poll() is None
    assert operator.beat(5) is None


def test_a_release_that_the_heartbeat_notices_first(operator: Operator) -> None:
    operator.beat(3)
    operator.service.press("forward")
    operator.now_s = FIRST_HOLD_S
    assert operator.beat(4) == ("teleop", "stop", 4, 0)
    assert operator.beat(5) is None


def test_changing_the_key_within_a_tick(operator: Operator) -> None:
    operator.beat(3)
    operator.service.press("forward")
    assert brief(operator.service.press("left")) == ("teleop", "left", 3, 1)
    assert brief(operator.service.press("forward")) == ("teleop", "forward", 3, 2)
    assert operator.service.press("forward") is None, "a repeat is no change"


def test_space_stops_even_while_another_drives(operator: Operator) -> None:
    operator.beat(3)
    assert brief(operator.service.press("stop")) == ("teleop", "stop", 3, 0)


def test_keys_without_a_robot_are_not_kept_for_one(operator: Operator) -> None:
    assert operator.service.press("forward") is None
    assert operator.beat(0) is None


def test_an_emergency_stop_goes_out_at_once_and_is_repeated_until_it_holds(operator: Operator) -> None:
    operator.beat(3)
    operator.service.press("forward")
    assert brief(operator.service.stop_for_emergency()) == ("emergency_stop", "stop", 3, 0)
    assert operator.beat(4, "command") == ("emergency_stop", "stop", 4, 0)
    assert operator.beat(5, "emergency_stop") is None
    assert operator.service.press("forward") is None, "it holds until it is released"
    assert operator.beat(6, "emergency_stop") is None


def test_an_emergency_stop_before_any_heartbeat_is_sent_with_the_first(operator: Operator) -> None:
    assert brief(operator.service.stop_for_emergency()) == ("emergency_stop", "stop", 0, 0)
    assert operator.beat(0) == ("emergency_stop", "stop", 0, 0)


def test_an_emergency_stop_between_two_episodes_is_sent(operator: Operator) -> None:
    operator.beat(3)
    operator.service.on_event(event("ended", outcome="aborted"))
    command = operator.service.stop_for_emergency()
    assert (command.source, command.robot, command.episode) == ("emergency_stop", "r", "e")


def test_the_episode_that_the_operator_asks_for_releases_the_emergency_stop(operator: Operator) -> None:
    operator.beat(3)
    operator.service.stop_for_emergency()
    operator.service.on_event(event("ended", outcome="aborted"))
    operator.service.release_emergency_stop()
    assert operator.service.emergency, "not before the simulator has done it"
    operator.service.on_event(event("started", "f"))
    assert not operator.service.emergency
    operator.beat(0, episode="f")
    assert brief(operator.service.press("left")) == ("teleop", "left", 0, 0)


def test_no_other_episode_releases_it(operator: Operator) -> None:
    operator.beat(3)
    operator.service.stop_for_emergency()
    operator.service.release_emergency_stop()
    operator.service.keep_emergency_stop()
    assert operator.beat(0, episode="f") == ("emergency_stop", "stop", 0, 0)
    assert operator.beat(1, "emergency_stop", "f") is None
    operator.service.on_event(event("started", "g"))
    assert operator.service.emergency


def test_an_emergency_stop_while_waiting_for_the_new_episode_stops_that_one(operator: Operator) -> None:
    operator.beat(3)
    operator.service.release_emergency_stop()
    assert operator.service.stop_for_emergency() is not None
    assert operator.beat(0, episode="f") == ("emergency_stop", "stop", 0, 0)


def test_nothing_is_sent_after_the_end(operator: Operator) -> None:
    operator.beat(3)
    operator.service.press("forward")
    operator.service.on_event(event("ended", outcome="collision"))
    assert operator.service.press("left") is None
    assert operator.beat(4) is None, "a heartbeat that the news of the end has overtaken"
    assert operator.service.poll() is None


def test_a_key_held_across_two_episodes_must_be_pressed_again(operator: Operator) -> None:
    operator.beat(3)
    operator.service.press("forward")
    assert operator.beat(0, episode="f") is None


steps = st.one_of(
    st.tuples(st.just("press"), st.sampled_from(["forward", "backward", "left", "right", "stop"])),
    st.tuples(st.just("wait"), st.floats(0, 1)),
    st.tuples(st.just("beat"), st.none()),
    st.tuples(st.just("emergency"), st.none()),
)


@given(st.lists(steps, max_size=60))
def test_whatever_happens_commands_are_in_order_and_end_with_a_stop(script: list[tuple[str, object]]) -> None:
    operator, sent, tick = Operator(), [], 0
    for kind, value in script:
        if kind == "press":
            sent.append(brief(operator.service.press(value)))
        elif kind == "wait":
            operator.now_s += value
            sent.append(brief(operator.service.poll()))
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


def test_the_status_line() -> None:
    now_s = 0.0
    status = Status(lambda: now_s)
    assert status.line(None, emergency=False) == "robot: -  |  you: -  |  no episode; press n to begin one"
    assert status.on_event(event("started")) == "frame 0: started (drive in yard, seed 1)"
    status.on_applied(applied(12, "command", "policy"))
    assert status.line("left", emergency=False) == (
        "frame 12  |  robot: stop (by policy)  |  refused 0  |  you: left  |  teleop drives"
    )
    status.on_applied(applied(13))
    assert "robot: stop (nobody drives)" in status.line(None, emergency=False)
    assert status.line(None, emergency=True).startswith("EMERGENCY STOP  |  ")
    now_s = 3.0
    assert "NO SIGN OF THE ROBOT for 3 s" in status.line(None, emergency=False)
    assert status.on_event(event("victim_found")).startswith("frame 0: victim found")
    assert status.on_event(event("ended", outcome="found")).startswith("frame 0: ended: found")
    status.on_applied(applied(14))
    assert status.line(None, emergency=False) == "robot: -  |  you: -  |  ended: found; press n for the next one"

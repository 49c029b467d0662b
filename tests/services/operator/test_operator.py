"""An operator begins what another driver drives, also after having taken over from one."""

from __future__ import annotations

import math
from collections.abc import Iterator

import pytest

from schemas.command import CommandApplied, StopCause
from schemas.episode import Episode
from schemas.rpc import ResetRequest
from services.kit.node import Node
from services.kit.settings import ServiceSettings
from services.operator.hold import KeyHold
from services.operator.operator import BEAT_S, POLL_S, Operator
from services.robot.clock import now_s
from tests.services.conftest import RunNode
from tests.services.robot.wheels import Robot, run_robot


class Notes:
    """Keeps what the operator is told."""

    def __init__(self) -> None:
        self.said: list[str] = []
        self.events: list[Episode] = []

    def say(self, text: str) -> None:
        self.said.append(text)

    def on_applied(self, applied: CommandApplied) -> None: ...

    def on_event(self, event: Episode) -> None:
        self.events.append(event)

    def on_request(self) -> None: ...

    def on_failure(self) -> None: ...

    def on_answer(self, cause: StopCause | None) -> None: ...

    def on_silence(self) -> None: ...


@pytest.fixture
def robot(settings: ServiceSettings, run_node: RunNode) -> Robot:
    return run_robot(settings, run_node, attended=False)


@pytest.fixture
def node(robot: Robot, settings: ServiceSettings) -> Iterator[Node]:
    with Node("teleop", settings) as node:
        yield node


@pytest.mark.parametrize("stopped", [False, True], ids=["taken over", "taken over and stopped"])
def test_a_driver_begins_anew_where_the_person_says_so_who_has_taken_over(
    node: Node, robot: Robot, stopped: bool
) -> None:
    notes = Notes()
    operator = Operator(node, KeyHold(now_s), notes)
    node.every(POLL_S, operator.poll)
    node.every(BEAT_S, operator.beat)
    run = ResetRequest(seed=1, purpose="run", driver="policy", mode="realtime")
    assert node.spin(lambda: operator.commands.to_release is not None, 10.0)
    assert operator.begin(run)
    assert node.spin(lambda: operator.mine is not None and operator.commands.applied is not None, 10.0)
    first = operator.mine
    operator.press("forward", math.inf)
    assert node.spin(lambda: robot.gate.taken_over and robot.wheels.driven, 10.0)
    operator.release()
    if stopped:
        operator.stop_for_emergency()
        assert node.spin(lambda: bool(operator.commands.stop), 10.0)
    assert operator.begin(run)
    assert node.spin(lambda: operator.mine not in (None, first), 10.0), notes.said
    assert not robot.gate.taken_over
    assert robot.gate.stop_cause is None
    ended = [event for event in notes.events if event.event == "ended"]
    assert [event.episode for event in ended] == [first]

"""Only commands on their own keys reach the gate of a robot."""

import pytest

from schemas.base import SOURCES
from schemas.codec import encode, encoding_of
from schemas.command import Command
from schemas.topics import COMMANDS, HEARTBEAT, PULSE
from services.kit.bus import Bus
from services.kit.node import Node
from services.kit.settings import ServiceSettings
from services.robot.clock import now_s
from services.robot.gate import CommandGate
from services.robot.loop import check_stopping
from services.robot.runner import EpisodeRunner
from services.robot.service import RobotService
from services.robot.task import OperatorsTask
from tests.services.conftest import RunNode
from tests.services.kit.test_refusals import stranger
from tests.services.robot.line import LineBody
from tests.services.waiting import eventually, ready, status_of


class Body(LineBody):
    braking_s = 0.1


@pytest.mark.zenoh
def test_no_forged_command_reaches_the_gate(
    settings: ServiceSettings, router_endpoint: str, run_node: RunNode, client: Bus
) -> None:
    """Any message on the key of the emergency stop stops the robot, however malformed."""
    body = Body(now_s)
    gate = CommandGate(first_stop=7)
    check_stopping(body)
    node = Node("robot", settings)
    RobotService(EpisodeRunner(body, OperatorsTask(), gate, settings.robot, "s"), node)
    run_node(node)
    ready(client, "robot")
    encoding = encoding_of(Command)
    latched = gate.latched_stop
    with stranger(router_endpoint) as session:
        for source in SOURCES:
            key = COMMANDS[source].key("rescuebot")
            command = Command(
                robot="rescuebot", episode="e", tick=1, stamp_ns=0, source=source, atom="forward"
            )
            session.put("**", encode(command), encoding=encoding)
            session.delete(key)
            session.put(key, encode(command), encoding="application/json")
            session.put(key, bytes(2_000), encoding=encoding)
        each = {COMMANDS[source].name: len(SOURCES) + 3 for source in SOURCES}
        each |= {topic.name: len(SOURCES) for topic in (HEARTBEAT, PULSE)}
        eventually(
            lambda: (status := status_of(client, "robot")) is not None and status.bad == each
        )
    status = status_of(client, "robot")
    assert set(status.received) <= {PULSE.name}  # its own
    assert gate.latched_stop == latched + each[COMMANDS["emergency_stop"].name]
    assert gate.stop_cause == "emergency_stop"

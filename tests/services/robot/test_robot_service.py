"""The robot on the bus: one robot for each id, forged commands, lost operators, opening worlds."""

import itertools
import os
import signal
import threading
import time

import pytest

from schemas.base import SOURCES
from schemas.codec import encode, encoding_of
from schemas.command import Command
from schemas.heartbeat import Pulse
from schemas.rpc import ArmRequest, CancelRequest, Nothing, ResetReply, ResetRequest
from schemas.topics import COMMANDS, HEARTBEAT, PULSE
from services.kit.bus import Bus, RpcError
from services.kit.going_on import each
from services.kit.node import Node, ServiceError
from services.kit.settings import ServiceSettings
from services.operator.operator import POLL_S, Operator
from services.robot import service
from services.robot.body import Beginning
from services.robot.clock import now_s
from services.robot.gate import CommandGate
from services.robot.loop import STAND_WITHIN_S, check_stopping
from services.robot.runner import EpisodeRunner
from services.robot.service import RobotService, RobotSettings, serve_robot
from services.robot.task import OperatorsTask
from tests.benchmarks.faults.proxy import link
from tests.services.conftest import RunNode
from tests.services.kit.test_refusals import stranger
from tests.services.operator.test_operator import RUN, asked
from tests.services.robot.line import LineBody
from tests.services.robot.wheels import Policy, Wheels, run_robot
from tests.services.waiting import Lost, eventually, ready, status_of


@pytest.mark.zenoh
def test_operator_is_lost_when_the_link_grows_slow(
    settings: ServiceSettings, router_endpoint: str, run_node: RunNode, client: Bus, lost_s: Lost
) -> None:
    robot = run_robot(settings, run_node, attended=True)
    Policy(settings, run_node)
    with link(router_endpoint) as way:
        far = settings.model_copy(update={"router": way.address})
        with Node("teleop", far) as node:
            operator = Operator(node, (said := []).append)
            node.every(POLL_S, operator.poll)

            assert node.spin(lambda: operator.commands.to_release is not None, 100.0)
            assert node.spin(asked(operator, RUN, lambda: robot.wheels.driven), 100.0), said
            os.kill(way.pid, signal.SIGUSR1)
            node.spin(timeout_s=3.0)  # then the link takes 1.5 s each way
            dead_s = time.monotonic()
            # From here on it answers nothing; what it has sent is under way.
            eventually(lambda: robot.gate.stop_cause == "operator_lost")
            eventually(lambda: not robot.wheels.driven)
            assert robot.wheels.stands_s - dead_s <= STAND_WITHIN_S + lost_s(dead_s)
            eventually(lambda: time.monotonic() - dead_s > 2.0 and robot.gate.operator is None)
    assert status_of(client, "robot") is not None


def robot_of(
    settings: ServiceSettings, run_node: RunNode, session: str, *, armed: bool = False
) -> RobotService:
    """Start a robot that has not asked whether there is another one."""
    wheels = Wheels()
    gate = CommandGate(first_stop=1)
    if armed:
        gate.arm(1, "")
    node = Node("robot", settings)
    found = RobotService(
        EpisodeRunner(wheels, OperatorsTask(), gate, settings.robot, session), node
    )
    run_node(node)
    return found


@pytest.mark.parametrize(
    ("one", "other", "stays"),
    [
        (("a", False), ("b", False), 0),
        (("b", False), ("a", False), 1),
        (("b", True), ("a", False), 0),
    ],
    ids=["the first", "the second", "who is armed"],
)
def test_of_two_robots_of_one_id_one_stays(
    settings: ServiceSettings,
    run_node: RunNode,
    one: tuple[str, bool],
    other: tuple[str, bool],
    stays: int,
) -> None:
    robots = [robot_of(settings, run_node, session, armed=armed) for session, armed in (one, other)]
    eventually(lambda: robots[1 - stays].left)
    heard: list[Pulse] = []
    watcher = Node("watcher", settings)
    watcher.at_once(PULSE, heard.append)
    run_node(watcher)
    eventually(lambda: {pulse.session for pulse in heard} >= {one[0], other[0]})
    assert not robots[stays].left


def test_one_of_two_simultaneous_robots_is_refused(
    settings: ServiceSettings, monkeypatch: pytest.MonkeyPatch, client: Bus
) -> None:
    asked = threading.Barrier(2)

    def check_alone(_: ServiceSettings) -> None:
        found.append(status_of(client, "robot"))
        asked.wait(100.0)

    def keep(node: Node) -> None:
        nodes.append(node)

    found: list[object] = []
    nodes: list[Node] = []
    monkeypatch.setattr(service, "check_alone", check_alone)
    monkeypatch.setattr(Node, "stop_on_signals", keep)
    own = RobotSettings(robot=settings.robot, router=settings.router, attended=False)
    refused: list[str] = []

    def serve() -> None:
        try:
            serve_robot(own, lambda _: (Wheels(), {}), OperatorsTask())
        except ServiceError as error:
            refused.append(str(error))

    threads = [threading.Thread(target=serve, daemon=True) for _ in range(2)]
    for thread in threads:
        thread.start()
    eventually(lambda: [thread.is_alive() for thread in threads].count(False) == 1)
    assert found == [None, None]
    assert refused == ["another robot rescuebot has been started; give this one another id"]
    eventually(lambda: status_of(client, "robot"))
    for node in nodes:
        node.stop()
    for thread in threads:
        thread.join(100.0)
    assert len(refused) == 1


class Endless(Wheels):
    """Opens a world of which there is always more."""

    def __init__(self) -> None:
        super().__init__()
        self.opens = threading.Event()

    def begin(self, request: ResetRequest) -> Beginning:
        if request.world is None:
            return super().begin(request)
        for _ in each(itertools.count()):
            self.opens.set()
            time.sleep(0.001)
        raise AssertionError


def test_only_requester_or_operator_cancels_an_opening_world(
    settings: ServiceSettings, run_node: RunNode, client: Bus
) -> None:
    wheels = Endless()
    gate = CommandGate()
    told = list[str]()
    runner = EpisodeRunner(wheels, OperatorsTask(), gate, settings.robot, "s")
    node = Node("robot", settings)
    RobotService(runner, node)
    run_node(node)
    client.call("robot", "arm", ArmRequest(stop=gate.latched_stop), Nothing)

    def cancel(session: str) -> str:
        try:
            client.call("robot", "cancel", CancelRequest(session=session), Nothing)
        except RpcError as error:
            return str(error)
        return "cancelled"

    def open_for(session: str) -> threading.Thread:
        def ask() -> None:
            with pytest.raises(RpcError) as refused:
                client.call(
                    "robot",
                    "reset",
                    ResetRequest(seed=1, mode="realtime", world="town", session=session),
                    ResetReply,
                )
            told.append(str(refused.value))

        wheels.opens.clear()
        thread = threading.Thread(target=ask, daemon=True)
        thread.start()
        assert wheels.opens.wait(100.0)
        return thread

    assert cancel("a") == "robot cancel: no episode is beginning; nothing to cancel"
    opening = open_for("a")
    assert (
        cancel("b")
        == "robot cancel: permission denied: only the requester of this episode or the operator "
        "may cancel it"
    )
    assert cancel("a") == "cancelled"
    opening.join(100.0)
    assert told == [
        "robot reset: cancelled by its requester; the robot is in line, without an episode"
    ]
    assert runner.running is None
    operates = threading.Event()
    with Node("teleop", settings) as desk:
        operator = Operator(desk, (said := []).append)
        desk.every(POLL_S, operator.poll)
        thread = threading.Thread(target=lambda: desk.spin(operates.is_set, 100.0), daemon=True)
        thread.start()
        eventually(lambda: gate.operator == desk.session)
        opening = open_for("a")
        operator.withdraw()
        opening.join(100.0)
        assert told[1:] == [
            "robot reset: cancelled by the operator; the robot is in line, without an episode"
        ], said
        operates.set()
        thread.join(100.0)
    reply = client.call("robot", "reset", ResetRequest(seed=1, mode="realtime"), ResetReply)
    assert reply.world == "line", "it takes the next request"


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

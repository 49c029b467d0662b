"""An operator begins episodes of other drivers, also after a takeover."""

import math
import threading
import time
from collections.abc import Callable, Iterator

import pytest

from schemas.base import KEYS
from schemas.episode import Episode
from schemas.rpc import ResetRequest
from schemas.topics import COMMANDS
from services.kit.bus import Bus
from services.kit.node import Node
from services.kit.settings import ServiceSettings
from services.operator.operator import POLL_S, Operator
from services.robot.body import Beginning
from services.robot.gate import ABSENT_S
from tests.services.conftest import RunNode
from tests.services.robot.wheels import Policy, Robot, run_robot
from tests.services.waiting import collected, eventually, status_of

RUN = ResetRequest(seed=1, purpose="run", driver="policy", mode="realtime")
DRIVE = RUN.model_copy(update={"purpose": "drive", "driver": "teleop"})


@pytest.fixture
def robot(request: pytest.FixtureRequest, settings: ServiceSettings, run_node: RunNode) -> Robot:
    return run_robot(settings, run_node, attended=getattr(request, "param", False))


@pytest.fixture
def node(robot: Robot, settings: ServiceSettings) -> Iterator[Node]:
    with Node("teleop", settings) as node:
        yield node


def misses_nobody(_now_s: float) -> None:
    """Miss no operator whom a busy machine holds up, where the test is about something else."""


@pytest.fixture
def said() -> list[str]:
    """Give the messages to the operator."""
    return []


@pytest.fixture
def operator(node: Node, said: list[str]) -> Operator:
    """Give an operator that knows the robot."""
    operator = Operator(node, said.append)
    node.every(POLL_S, operator.poll)
    assert node.spin(lambda: operator.commands.to_release is not None, 100.0)
    return operator


def asked(
    operator: Operator, request: ResetRequest, done: Callable[[], bool]
) -> Callable[[], bool]:
    """Ask for an episode until something holds: again where a busy machine missed the operator, as a person would."""
    before = operator.mine

    def is_done() -> bool:
        if operator.mine in (None, before) and not operator.asking:
            operator.begin(request)
        return done()

    return is_done


@pytest.mark.parametrize("stopped", [False, True], ids=["taken over", "taken over and stopped"])
def test_driver_begins_anew_when_the_operator_takes_over(
    node: Node,
    client: Bus,
    robot: Robot,
    operator: Operator,
    said: list[str],
    stopped: bool,
) -> None:
    begun = asked(
        operator, RUN, lambda: operator.mine is not None and operator.commands.applied is not None
    )
    assert node.spin(begun, 100.0), said
    first = operator.mine
    seen = {"event": "victim_found", "purpose": "run", "driver": "policy", "world": "w", "seed": 1}
    client.publish(Episode.after(operator.commands.heard, **seen))
    assert node.spin(
        lambda: any(line.endswith(": the victim is near and in view") for line in said), 100.0
    ), said
    operator.hold(KEYS["forward"], math.inf)
    assert node.spin(lambda: robot.gate.taken_over and robot.wheels.driven, 100.0)
    operator.hold(None)
    if stopped:
        operator.stop_for_emergency()
        assert node.spin(lambda: bool(operator.commands.stop), 100.0)

    assert node.spin(asked(operator, RUN, lambda: operator.mine not in (None, first)), 100.0), said
    assert not robot.gate.taken_over
    assert robot.gate.stop_cause is None
    assert (
        len(
            [line for line in said if line.startswith("Run to victim: ended before the goal after")]
        )
        == 1
    ), "the first one"


def test_stop_is_repeated_when_the_robot_is_silent(settings: ServiceSettings, client: Bus) -> None:
    stops = collected(client, COMMANDS["emergency_stop"])
    with Node("teleop", settings) as node:
        operator = Operator(node, lambda _: None)
        operator.stop_for_emergency()
        assert node.spin(lambda: len(stops) >= 3, 100.0)


attended = pytest.mark.parametrize("robot", [True], indirect=True, ids=["attended"])


def there(robot: Robot, node: Node) -> bool:
    return (robot.gate.operator, robot.gate.stop_cause) == (node.session, None)


@attended
def test_robot_with_slow_pictures_does_not_miss_its_operator(
    node: Node, robot: Robot, operator: Operator, said: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(robot.wheels, "render", lambda _x: time.sleep(0.3))
    assert node.spin(
        asked(operator, DRIVE, lambda: operator.commands.applied is not None), 100.0
    ), said
    since = operator.commands.heard.tick

    def five_frames() -> bool:
        nonlocal since
        if not there(
            robot, node
        ):  # which a busy machine may do once, and such a robot would with every frame
            since = operator.commands.heard.tick
            operator.resume()
        return operator.commands.heard.tick >= since + 5

    assert node.spin(five_frames, 100.0), said


@attended
@pytest.mark.parametrize("stays", [True, False])
def test_robot_that_opens_a_world_misses_only_a_lost_operator(
    node: Node,
    robot: Robot,
    operator: Operator,
    client: Bus,
    run_node: RunNode,
    settings: ServiceSettings,
    monkeypatch: pytest.MonkeyPatch,
    stays: bool,
) -> None:
    opening = threading.Event()
    opened = threading.Event()
    begin = robot.wheels.begin

    def open_world(request: ResetRequest) -> Beginning:
        opening.set()
        assert opened.wait(100.0)
        return begin(request)

    monkeypatch.setattr(robot.wheels, "begin", open_world)
    Policy(settings, run_node)

    def open_it() -> None:
        opening.clear()
        opened.clear()
        assert node.spin(asked(operator, RUN, opening.is_set), 100.0)
        node.spin(timeout_s=4 * ABSENT_S)
        assert there(robot, node)
        if not stays:
            time.sleep(2 * robot.gate.absent_s)  # dead: it answers no pulse
        opened.set()

    open_it()
    if stays:
        for _ in range(
            4
        ):  # which a busy machine may miss now and then; such a robot would miss them each time
            assert node.spin(
                lambda: robot.wheels.driven or robot.gate.stop_cause is not None, 100.0
            )
            if robot.wheels.driven:
                return
            open_it()
        pytest.fail(str(robot.gate.stop_cause))
    else:
        eventually(lambda: robot.gate.stop_cause == "operator_lost")
        eventually(lambda: status_of(client, "robot"))
        assert all(atom == "stop" for _, atom in robot.wheels.told)

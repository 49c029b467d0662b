"""One dead lane to the router, of the robot or of its operator: the robot stands in time."""

import math
import time
from collections.abc import Iterator

import pytest

from schemas.base import KEYS
from schemas.command import Command
from schemas.rpc import ArmRequest, Nothing, ResetReply
from schemas.topics import Lane
from services.kit.bus import Bus
from services.kit.node import Node
from services.kit.settings import ServiceSettings
from services.operator.operator import POLL_S, Operator
from services.robot.loop import STAND_WITHIN_S
from tests.benchmarks.faults.proxy import Harm, Link, link
from tests.services.conftest import RunNode
from tests.services.operator.test_operator import DRIVE, RUN
from tests.services.robot.wheels import Policy, Robot, run_robot
from tests.services.waiting import Lost, eventually

pytestmark = pytest.mark.zenoh
HARMS: list[tuple[Harm, Lane]] = [
    ("cut", "stop"),
    ("cut", "urgent"),
    ("deafen", "stop"),
    ("deafen", "urgent"),
]


@pytest.fixture
def way(router_endpoint: str) -> Iterator[Link]:
    with link(router_endpoint, batches=True) as way:
        yield way


@pytest.fixture
def far(settings: ServiceSettings, way: Link) -> ServiceSettings:
    return settings.model_copy(update={"router": way.address})


def drive(client: Bus, robot: Robot) -> None:
    """Have the policy drive the robot."""
    client.call("robot", "arm", ArmRequest(stop=robot.gate.latched_stop), Nothing)
    client.call("robot", "reset", RUN, ResetReply)
    eventually(lambda: robot.wheels.driven)


def stands_after(robot: Robot, way: Link, harm: Harm, lane: Lane, lost_s: Lost) -> None:
    """Harm a lane, and check that the robot stands in time."""
    harmed_s = time.monotonic()
    way.harm(harm, lane)
    eventually(lambda: not robot.wheels.driven)
    assert robot.wheels.stands_s - harmed_s <= STAND_WITHIN_S + lost_s(harmed_s)


@pytest.mark.parametrize(("harm", "lane"), HARMS)
def test_robot_stands_when_its_lane_is_dead(
    far: ServiceSettings, settings: ServiceSettings, way: Link, run_node: RunNode, client: Bus, lost_s: Lost,
    harm: Harm, lane: Lane,
) -> None:  # fmt: skip
    robot = run_robot(far, run_node, attended=False)
    policy = Policy(settings, run_node)
    drive(client, robot)
    stands_after(robot, way, harm, lane, lost_s)
    if lane == "stop":  # The policy drives on, and stops sent meanwhile do not arrive.
        heard = len(policy.applied)
        for number in range(30):
            stop = Command.after(
                policy.applied[-1], source="emergency_stop", sequence=number, atom="stop"
            )
            client.publish(stop)
        eventually(lambda: len(policy.applied) > heard + 10)
        assert policy.applied[-1].reason == "deaf"
    assert not robot.wheels.driven
    assert robot.gate.stop_cause is None, "it was not reached"


def test_robot_drives_on_when_its_lane_is_mended(
    far: ServiceSettings,
    settings: ServiceSettings,
    way: Link,
    run_node: RunNode,
    client: Bus,
    lost_s: Lost,
) -> None:
    robot = run_robot(far, run_node, attended=False)
    Policy(settings, run_node)
    drive(client, robot)
    stands_after(robot, way, "deafen", "stop", lost_s)
    way.mend()
    eventually(lambda: robot.wheels.driven)


@pytest.mark.parametrize("harmed", ["robot", "operator"])
@pytest.mark.parametrize(("harm", "lane"), [*HARMS, ("mute", "stop")])
def test_attended_robot_is_stopped_when_a_lane_is_harmed(
    far: ServiceSettings, settings: ServiceSettings, way: Link, run_node: RunNode, lost_s: Lost,
    harmed: str, harm: Harm, lane: Lane,
) -> None:  # fmt: skip
    robot = run_robot(far if harmed == "robot" else settings, run_node, attended=True)
    with Node("teleop", settings if harmed == "robot" else far) as node:
        operator = Operator(node, (told := []).append)
        node.every(POLL_S, operator.poll)

        def drives() -> bool:
            if (
                operator.mine is None
                and not operator.asking
                and operator.commands.to_release is not None
            ):
                operator.begin(DRIVE)
            elif operator.commands.applied is not None:
                operator.hold(KEYS["forward"], math.inf)
            return robot.wheels.driven

        assert node.spin(drives, 100.0), told
        harmed_s = time.monotonic()
        way.harm(harm, lane)
        deaf_operator = harmed == "operator" and harm == "deafen" and lane == "stop"
        if deaf_operator:  # By this lane an operator receives nothing; what they send arrives.
            operator.stop_for_emergency()
        assert node.spin(lambda: not robot.wheels.driven, 10.0)
        assert robot.wheels.stands_s - harmed_s <= STAND_WITHIN_S + lost_s(harmed_s)
        assert node.spin(lambda: robot.gate.stop_cause is not None or harmed == "robot", 10.0)

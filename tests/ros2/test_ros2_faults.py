"""Harm a driven fake TurtleBot: by its own log its wheels stand in time."""

import math
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from dataclasses import dataclass

import pytest

from schemas import topics
from schemas.codec import decode
from schemas.command import Command
from schemas.motion import Odometry
from services.cli.stack import free_endpoint
from services.kit.bus import Bus, Router
from services.robot.loop import STAND_WITHIN_S
from tests.ros2.fake_turtlebot import now_s
from tests.ros2.field import Field, Robot, robot_for
from tests.services.real_base import DrivenBase, until
from tests.services.waiting import collected

pytestmark = [pytest.mark.rendering, pytest.mark.zenoh, pytest.mark.system]
#: How long a fault lasts: what is frozen for longer than Zenoh's links take to notice, which is 2 s.
FAULT_S = {"kill": 1.0, "freeze": 2.5}
AHEAD_S = 3600.0  # By how much the robot's clock is ahead of ours.


@dataclass
class Driven(DrivenBase):
    """A fake robot, the service that drives it, and a driver that turns it on the spot."""

    place: Field
    bus: Bus
    endpoint: str
    robot: subprocess.Popen[bytes] | None = None
    drives: bool = True

    def start(self) -> None:
        """Start the service."""
        with (self.place.robot.folder / "robot.log").open("ab") as log:
            flags = f"--router {self.endpoint} --robot fake --attended false --robot-config"
            config = self.place.robot.folder / "fake.yaml"
            command = [sys.executable, "-m", "services.ros2", *flags.split(), str(config)]
            self.robot = subprocess.Popen(command, stdout=log, stderr=log)

    def answer(self, payload: bytes, encoding: str, _transit_s: float | None) -> None:
        """Answer a frame."""
        if self.drives:
            self.bus.publish(
                Command.after(decode(Odometry, payload, encoding), source="expert", atom="left")
            )

    @property
    def moving(self) -> bool:
        """Whether the wheels turn."""
        return self.place.moving


@pytest.fixture(scope="module")
def driven(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Driven]:
    """Have a robot of Humble that turns on the spot; a day of Jazzy is another test."""
    robot = Robot(
        tmp_path_factory.mktemp("ros2"),
        size=(64, 48),
        humble=True,
        twist="TwistStamped",
        encoding="yuv422",
        clock_offset=AHEAD_S,
        renders=False,
    )
    with ExitStack() as stacked:
        place = stacked.enter_context(robot_for(robot))
        place.config()
        endpoint = free_endpoint()
        stacked.callback(Router(endpoint).close)
        bus = stacked.enter_context(closing(Bus("fake", endpoint)))
        one = Driven(place, bus, endpoint)
        bus.subscribe(topics.ODOMETRY, one.answer)
        one.start()
        try:
            until(one.moves)
            yield one
        finally:
            one.robot.kill()
            one.robot.wait()


@pytest.mark.parametrize("harm", FAULT_S)
@pytest.mark.parametrize("part", ["robot", "router", "camera"])
def test_base_stands_in_time_and_drives_again_when_harmed(
    driven: Driven, lost_s: Callable[[float], float], part: str, harm: str
) -> None:
    until(driven.moves)
    child = driven.robot if part == "robot" else driven.place.children[part]
    began_s = now_s()
    child.send_signal(signal.SIGKILL if harm == "kill" else signal.SIGSTOP)
    time.sleep(FAULT_S[harm])  # The wheels must stand until the fault ends.
    ended_s = now_s()
    steps = [step for step in driven.place.steps(began_s) if step[0] <= ended_s]
    if harm == "freeze":
        child.send_signal(signal.SIGCONT)
    else:
        child.wait()
        driven.start() if part == "robot" else driven.place.start(part)
    moved = [step[0] - began_s for step in steps if step[3] or step[4]]
    assert len(steps) > FAULT_S[harm] / 0.02 / 2, "the log of the wheels is incomplete"
    assert max(moved, default=0.0) <= STAND_WITHIN_S + lost_s(began_s)
    until(driven.moves)


def test_odometry_continues_when_the_base_restarts(driven: Driven) -> None:
    until(driven.moves)
    heard = collected(driven.bus, topics.ODOMETRY)
    until(lambda: heard)
    base = driven.place.children["base"]
    base.kill()
    base.wait()
    until(lambda: driven.detail.get("lacks"))
    before = heard[-1]
    driven.place.start("base")
    until(lambda: driven.detail.get("lacks") is None)
    count = len(heard)
    until(lambda: len(heard) > count + 2)
    assert heard[-1].episode == before.episode
    assert abs(math.remainder(heard[-1].heading_rad - before.heading_rad, math.tau)) < 0.5
    until(driven.moves)


def test_base_stands_when_its_driver_is_silent(
    driven: Driven, lost_s: Callable[[float], float]
) -> None:
    until(driven.moves)
    driven.drives = False
    began_s = now_s()
    time.sleep(1.0)
    moved = [step[0] - began_s for step in driven.place.steps(began_s) if step[3] or step[4]]
    driven.drives = True
    assert max(moved, default=0.0) <= STAND_WITHIN_S + lost_s(began_s)
    until(driven.moves)


def test_status_and_log_name_velocity_type_and_clock_offset(
    driven: Driven,
) -> None:
    detail = driven.detail
    assert detail["velocity_type"] == "geometry_msgs/msg/TwistStamped"
    log = (driven.place.robot.folder / "robot.log").read_text()
    assert "/cmd_vel: sending geometry_msgs/msg/TwistStamped" in log
    assert abs(float(str(detail["robot_clock_ahead_s"])) - AHEAD_S) < 0.5
    assert detail["lacks"] is None

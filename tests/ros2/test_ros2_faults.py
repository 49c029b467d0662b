"""Harm a driven fake TurtleBot: by its own log its wheels stand in time."""

import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, suppress
from dataclasses import dataclass, replace

import pytest

from schemas import topics
from schemas.codec import decode
from schemas.command import Command
from schemas.motion import Odometry
from schemas.rpc import ArmRequest, Nothing, ResetReply, ResetRequest, Status
from services.cli.stack import free_endpoint
from services.kit.bus import Bus, Router, RpcError
from services.robot.loop import STAND_WITHIN_S
from tests.ros2.fake_turtlebot import now_s
from tests.ros2.field import Field, Robot, robot_for, until
from tests.services.waiting import collected

pytestmark = [pytest.mark.rendering, pytest.mark.zenoh, pytest.mark.system]
#: How long a fault lasts: what is frozen for longer than Zenoh's links take to notice, which is 2 s.
FAULT_S = {"kill": 1.0, "freeze": 2.5}
AHEAD_S = 3600.0  # By how much the robot's clock is ahead of ours.
DIALECTS = (
    "rmw_zenoh of humble, stamped",
    "zenoh-bridge-ros2dds",
)  # A day of rmw_zenoh of jazzy is another test.
#: The harmed part and the fault. Most is the same in all dialects.
EVERY_HARM = [(part, harm) for part in ("robot", "router", "camera") for harm in FAULT_S]
HARMS = {DIALECTS[0]: EVERY_HARM, DIALECTS[1]: [("router", "freeze")]}


@dataclass
class Driven:
    """A fake robot, the service that drives it, and a driver that turns it on the spot."""

    place: Field
    bus: Bus
    endpoint: str
    dialect: str
    robot: subprocess.Popen[bytes] | None = None
    drives: bool = True

    def start(self) -> None:
        """Start the service."""
        with (self.place.robot.folder / "robot.log").open("ab") as log:
            command = [
                sys.executable,
                "-m",
                "services.ros2",
                "--router",
                self.endpoint,
                "--robot",
                "fake",
            ]
            command += [
                "--attended",
                "false",
                "--ros2-config",
                str(self.place.robot.folder / "fake.yaml"),
            ]
            self.robot = subprocess.Popen(command, stdout=log, stderr=log)

    def answer(self, payload: bytes, encoding: str, _transit_s: float | None) -> None:
        """Answer a frame."""
        if self.drives:
            self.bus.publish(
                Command.after(decode(Odometry, payload, encoding), source="expert", atom="left")
            )

    @property
    def detail(self) -> dict[str, object]:
        """Return the status of the service, empty while it does not answer."""
        try:
            return dict(self.bus.call("robot", "status", Nothing(), Status, timeout_s=1.0).detail)
        except RpcError:
            return {}

    def moves(self) -> bool:
        """Have it move, if it does not: arm it, begin an episode."""
        detail = self.detail
        if not detail:
            return False
        with suppress(RpcError):
            if detail["emergency_stop"]:
                self.bus.call(
                    "robot", "arm", ArmRequest(stop=int(str(detail["emergency_stop"]))), Nothing
                )
            if detail["episode"] is None:
                request = ResetRequest(seed=1, driver="expert", mode="realtime", max_ticks=100_000)
                self.bus.call("robot", "reset", request, ResetReply)
        began_s = now_s()
        with suppress(AssertionError):
            until(lambda: self.place.moving and now_s() - began_s > 0.3, 2.0)
        return self.place.moving


@pytest.fixture(scope="module", params=DIALECTS)
def driven(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Driven]:
    """Have a robot that turns on the spot."""
    folder = tmp_path_factory.mktemp("ros2")
    humble = "humble" in request.param
    dialect = request.param.split(" ")[0]
    robot = Robot(folder, dialect=dialect, size=(64, 48), clock_offset=AHEAD_S, renders=False)
    if humble:
        robot = replace(robot, humble=True, encoding="yuv422", twist="TwistStamped")
    with ExitStack() as stacked:
        place = stacked.enter_context(robot_for(robot))
        place.config()
        endpoint = free_endpoint()
        stacked.callback(Router(endpoint).close)
        bus = stacked.enter_context(closing(Bus("fake", endpoint)))
        one = Driven(place, bus, endpoint, request.param)
        bus.subscribe(topics.ODOMETRY, one.answer)
        one.start()
        try:
            until(one.moves)
            yield one
        finally:
            one.robot.kill()
            one.robot.wait()


def test_the_base_stands_in_time_and_drives_again(
    driven: Driven, lost_s: Callable[[float], float]
) -> None:
    for part, harm in HARMS[driven.dialect]:
        until(driven.moves)
        pid = driven.robot.pid if part == "robot" else driven.place.children[part].pid
        began_s = now_s()
        os.kill(pid, signal.SIGKILL if harm == "kill" else signal.SIGSTOP)
        time.sleep(
            FAULT_S[harm]
        )  # the fault lasts; that the wheels stand until its end is what is to be seen
        ended_s = now_s()
        steps = [step for step in driven.place.steps(began_s) if step[0] <= ended_s]
        if harm == "freeze":
            os.kill(pid, signal.SIGCONT)
        elif part == "robot":
            driven.robot.wait()
            driven.start()
        else:
            driven.place.children[part].wait()
            driven.place.start(part)
        moved = [step[0] - began_s for step in steps if step[3] or step[4]]
        assert len(steps) > FAULT_S[harm] / 0.02 / 2, (
            f"{part} {harm}: its log says what the wheels did"
        )
        assert max(moved, default=0.0) <= STAND_WITHIN_S + lost_s(began_s), f"{part} {harm}"
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


def test_a_driver_that_is_silent_is_noticed(
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
    wanted = "TwistStamped" if driven.place.robot.humble else "Twist"
    assert detail["velocity_type"] == f"geometry_msgs/msg/{wanted}"
    log = (driven.place.robot.folder / "robot.log").read_text()
    assert f"/cmd_vel: sending geometry_msgs/msg/{wanted}" in log
    assert abs(float(str(detail["robot_clock_ahead_s"])) - AHEAD_S) < 0.5
    assert detail["lacks"] is None

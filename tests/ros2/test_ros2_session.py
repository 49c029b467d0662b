"""The session with a robot's router: buttons that report only changes, and messages that are too large."""

import math
import os
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import zenoh

from services.cli.stack import free_endpoint
from services.kit.node import ServiceError
from services.kit.ros_message import LARGEST_BYTES
from services.ros2.config import read_config
from services.ros2.messages import BOOL, COMPRESSED_IMAGE
from services.ros2.senses import Senses
from services.ros2.session import Ros2Session
from tests.benchmarks.faults.proxy import link
from tests.ros2.fake_turtlebot import Ros, opened
from tests.services.waiting import eventually

pytestmark = pytest.mark.zenoh
BUTTON = "/button"
NOTHING_S = 0.5  # How long it is seen that nothing comes; what comes takes some milliseconds.


@dataclass
class Place:
    """A router, a robot with a button, and the session of the service."""

    folder: Path
    dialect: str
    latched: bool
    endpoint: str = field(default_factory=free_endpoint)
    velocity: str = "{type: geometry_msgs/msg/Twist}"

    def __post_init__(self) -> None:
        self.router = opened("router", self.endpoint)
        self.robot: Ros | None = None

    def start_robot(self) -> Callable[[bool], None]:
        """Start the robot's process; return a function that presses or releases its button."""
        options = {"humble": False, "clock_offset": 0.0}
        robot = Ros(
            "robot", SimpleNamespace(endpoint=self.endpoint, dialect=self.dialect, **options)
        )
        say = robot.publisher("button", BOOL, latched=self.latched)
        self.robot = robot
        return lambda pressed: say(data=pressed)

    def listen(self, stack: ExitStack) -> Senses:
        """Start the service's side, for which the button is all that must be heard."""
        config = read_config(self.config(self.folder, self.endpoint, self.dialect, self.velocity))
        senses = Senses(config)
        self.session = stack.enter_context(closing(Ros2Session(config, senses)))
        return senses

    @staticmethod
    def config(folder: Path, endpoint: str, dialect: str, velocity: str = velocity) -> Path:
        """Write the configuration of this robot for the service."""
        path = folder / "robot.yaml"
        path.write_text(
            f"preset: generic\nwatchdog_s: 0.2\nrouter: {endpoint}\ndialect: {dialect}\nodometry: null\n"
            f"velocity: {velocity}\n"
            f"stops: [{{topic: button, type: {BOOL}, silence_s: null}}]\n"
        )
        return path

    def close(self) -> None:
        if self.robot is not None:
            self.robot.session.close()
        self.router.close()


@pytest.fixture
def stack() -> Iterator[ExitStack]:
    with ExitStack() as stacked:
        yield stacked


@pytest.fixture(params=["rmw_zenoh", "zenoh-bridge-ros2dds"])
def make(
    request: pytest.FixtureRequest, tmp_path: Path, stack: ExitStack
) -> Callable[[bool], Place]:
    """Return a function that makes a place, with a latched button or not."""
    return lambda latched: stack.enter_context(closing(Place(tmp_path, request.param, latched)))


def test_age_is_at_least_the_delay_when_a_link_is_late(tmp_path: Path, stack: ExitStack) -> None:
    place = stack.enter_context(closing(Place(tmp_path, "rmw_zenoh", False)))
    place.start_robot()
    show = place.robot.publisher("camera/image_raw/compressed", COMPRESSED_IMAGE)
    router = place.endpoint
    late = stack.enter_context(link(router))
    place.endpoint = late.address
    senses = place.listen(stack)
    os.kill(late.pid, signal.SIGUSR1)
    time.sleep(2.0)  # the delay grows by half a second a second
    shown = 0
    while shown < 5:
        frame = senses.frame

        def arrives() -> bool:  # A picture may be lost: the late link may have closed.
            stamp_ns = time.time_ns()
            stamp = {"sec": stamp_ns // 10**9, "nanosec": stamp_ns % 10**9}
            show(header={"stamp": stamp}, format="jpeg", data=np.zeros(8, np.uint8))
            time.sleep(0.1)
            return senses.frame is not frame  # noqa: B023

        eventually(arrives)
        stamp = senses.frame.message.header.stamp
        delay_s = time.time() - stamp.sec - stamp.nanosec / 1e9
        if not math.isfinite(senses.camera_clock.delay_s):
            continue  # no echo has come back yet
        shown += 1
        assert 0.9 * delay_s <= senses.camera_clock.delay_s
        assert delay_s > 0.5


def unheard(senses: Senses) -> bool:
    return senses.silent() == f"no message received from {BUTTON}"


def pressed(senses: Senses) -> bool:
    return not unheard(senses) and senses.forbids("left") is not None


def released(senses: Senses) -> bool:
    return not unheard(senses) and senses.forbids("left") is None


def test_button_is_seen_when_it_was_pressed_before_the_start(
    make: Callable[[bool], Place], stack: ExitStack
) -> None:
    place = make(True)
    say = place.start_robot()
    say(True)
    senses = place.listen(stack)
    eventually(lambda: pressed(senses))
    say(False)
    eventually(lambda: released(senses))


def test_robot_stands_when_its_button_is_silent_or_gone(
    make: Callable[[bool], Place], stack: ExitStack
) -> None:
    place = make(False)
    say = place.start_robot()
    say(True)  # nobody keeps it
    senses = place.listen(stack)
    time.sleep(NOTHING_S)
    assert unheard(senses)
    eventually(lambda: (say(False), released(senses))[1])
    place.robot.session.close()
    eventually(lambda: place.session.lacks() == f"{BUTTON} has no publisher")
    say = place.start_robot()
    eventually(lambda: place.session.lacks() is None)
    assert unheard(senses)
    eventually(lambda: (say(False), released(senses))[1])


@pytest.mark.parametrize("latched", [True, False])
def test_button_state_is_fetched_after_an_outage(
    make: Callable[[bool], Place], stack: ExitStack, *, latched: bool
) -> None:
    place = make(latched)
    say = place.start_robot()
    senses = place.listen(stack)
    eventually(lambda: (say(False), released(senses))[1])
    place.router.close()
    eventually(place.session.lacks)
    say(True)
    place.router = opened("router", place.endpoint)
    eventually(lambda: place.session.lacks() is None)
    if latched:
        eventually(lambda: pressed(senses))
    else:
        time.sleep(NOTHING_S)
        assert unheard(senses)
        eventually(lambda: (say(True), pressed(senses))[1])
    assert not senses.refused


def test_message_is_dropped_when_it_is_too_large(
    make: Callable[[bool], Place], stack: ExitStack
) -> None:
    place = make(False)
    say: Any = place.start_robot()
    senses = place.listen(stack)
    eventually(lambda: (say(False), released(senses))[1])
    key = place.robot._names("MP", "button", BOOL)[0]
    block = zenoh.CongestionControl.BLOCK
    place.robot.session.put(key, bytes(2 * LARGEST_BYTES), congestion_control=block)
    eventually(lambda: (say(True), pressed(senses))[1])
    assert not senses.refused
    place.robot.session.put(key, bytes(100_000), congestion_control=block)
    eventually(lambda: senses.refused[BUTTON])


@pytest.mark.parametrize("stamped", ["", "Stamped"])
def test_car_receives_speed_and_steering_angle(
    make: Callable[[bool], Place], stack: ExitStack, stamped: str
) -> None:
    place = make(True)
    place.velocity = "{topic: drive, wheelbase_m: 0.3}\nradius_m: 0.6"
    place.start_robot()
    assert place.robot is not None
    told = list[tuple[float, float]]()

    def take(message: Any) -> None:
        drive = message.drive if stamped else message
        told.append((drive.speed, drive.steering_angle))

    place.robot.subscribe("drive", f"ackermann_msgs/msg/AckermannDrive{stamped}", take)
    place.listen(stack)
    eventually(lambda: place.session.lacks() is None)
    left_rad = math.atan(0.3 / 0.6)
    # To the left, the same in backing, straight on, and standing.
    orders = (0.6, 1, left_rad), (-0.6, 1, -left_rad), (0.6, 0, 0), (0, 0, 0)
    for ahead_m_s, turn_rad_s, angle_rad in orders:
        expected = pytest.approx((ahead_m_s, angle_rad), rel=1e-6)

        def drives_so(
            order: tuple[float, float] = (ahead_m_s, turn_rad_s), as_told: object = expected
        ) -> bool:
            place.session.send(*order, 5.0)
            return bool(told) and told[-1] == as_told

        eventually(drives_so)


def test_error_is_one_line_when_no_robot_is_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("services.ros2.session.PATIENCE_MS", 300)
    config = read_config(Place.config(tmp_path, nowhere := free_endpoint(), "rmw_zenoh"))
    with pytest.raises(
        ServiceError, match=rf"^base: no Zenoh router at {nowhere}; on the robot start rmw_zenohd"
    ):
        Ros2Session(config, Senses(config))

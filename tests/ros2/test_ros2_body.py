"""A ROS 2 base as a body, without Zenoh: messages in, velocities out."""

import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from schemas.base import KEYS, Velocity
from services.kit.jpeg import decode_jpeg
from services.kit.node import ServiceError
from services.robot.body import check_conditions
from services.robot.gate import MAX_AGE_S
from services.robot.wheel_track import WheelTrack
from services.ros2 import messages
from services.ros2.messages import MessageError
from services.ros2.senses import picture
from tests.ros2.fake_turtlebot import encoded
from tests.ros2.rig import AHEAD_S, BEGIN, CAMERA, ODOM, PICTURE, ROS, Rig

ALL = "forward backward left right"


@pytest.fixture
def rig(tmp_path: Path) -> Rig:
    return Rig(tmp_path)


def test_shares_become_velocities(rig: Rig) -> None:
    rig.begun()
    for share in ((0.5, 0.0), (-0.5, 0.5), (0.0, -0.5), (0.0, 0.0)):
        rig.body.drive(Velocity(*share))
    assert rig.air.sent == [(0.25, 0.0), (-0.25, 0.75), (0.0, -0.75), (0.0, 0.0)]
    assert rig.air.robot_s == pytest.approx(rig.clock.now_s + AHEAD_S)


@pytest.mark.parametrize(
    ("silent", "topic"), [("wheels", "/odom"), ("scan", "/scan"), ("hazards", "/hazards")]
)
def test_robot_stands_when_a_required_topic_is_silent(rig: Rig, silent: str, topic: str) -> None:
    rig.begun()
    for _ in range(60):
        rig.passes(0.01, silent)
    assert not rig.may_go("forward")
    assert rig.clock.now_s - rig.body.look(1).captured_s >= MAX_AGE_S
    assert topic in str(rig.body.detail()["lacks"])
    rig.passes(0.01)
    assert rig.may_go("forward")


def test_button_that_reports_changes_must_have_reported_once(tmp_path: Path) -> None:
    rig = Rig(tmp_path, stops=", {topic: button, type: std_msgs/msg/Bool, silence_s: null}")
    rig.known()
    with pytest.raises(ServiceError, match=r"^base: no message received from /button; does"):
        rig.body.begin(BEGIN)
    assert not rig.may_go("forward")
    rig.says("/button", data=True)
    with pytest.raises(ServiceError, match="its stop topic is true"):
        rig.body.drive(KEYS["forward"])
    rig.says("/button", data=False)
    assert rig.may_go("forward")
    rig.clock.now_s += 3600
    rig.begun()
    assert rig.may_go("forward")
    rig.senses.forget("/button")
    assert not rig.may_go("forward")


def test_base_is_ordered_to_stand_when_it_is_unreachable(rig: Rig) -> None:
    rig.begun().air.lack = "/cmd_vel has no subscriber"
    assert not rig.may_go("forward")
    with pytest.raises(
        ServiceError, match=r"^base: /cmd_vel has no subscriber; does tcp/\S+ reach it"
    ):
        rig.body.begin(BEGIN)


def test_reason_is_logged_once_when_the_base_stands(
    rig: Rig, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO", "ros2")
    rig.begun().air.lack = "no connection to tcp/robot:7447"
    for lack in (rig.air.lack, rig.air.lack, None, None):
        rig.air.lack = lack
        rig.body.look(1)
    assert [record.getMessage() for record in caplog.records] == [
        "base stands: no connection to tcp/robot:7447",
        "base: required topics are back",
    ]


def test_frame_is_not_new_when_the_camera_is_silent_or_invalid(rig: Rig) -> None:
    seen = rig.begun().body.look(0)
    assert rig.body.peek() == seen.jpeg
    rig.passes(0.3, "picture")
    assert rig.body.look(1).captured_s == seen.captured_s
    assert rig.body.peek() is None, "nor is an old one shown between episodes"
    rig.picture(data=b"\xff\xd8 nothing")
    again = rig.body.look(2)
    assert again.captured_s == seen.captured_s
    assert again.jpeg == seen.jpeg
    assert rig.senses.refused[CAMERA] == 1


@pytest.mark.parametrize(
    ("numbers", "allowed", "touched"),
    [
        ((), ALL, False),
        ((0,), "forward left right", False),
        ((1,), "backward", True),
        ((2,), "backward", False),
        ((3,), "", False),
        ((4,), "", False),
        ((5,), "backward left right", False),
        ((77,), "", False),
        ((0, 5), "left right", False),
    ],
)
def test_hazards_forbid_motions_that_worsen_them(
    rig: Rig, numbers: tuple[int, ...], allowed: str, touched: bool
) -> None:
    rig.begun().hazards(*numbers)
    assert rig.ways() == allowed
    assert rig.body.look(1).contact == touched
    if "forward" not in allowed:
        with pytest.raises(
            ServiceError, match=r"must not move forward: .* it stands until it is armed"
        ):
            rig.body.drive(KEYS["forward"])
        assert rig.air.sent[-1] == (0.0, 0.0)


@pytest.mark.parametrize(
    ("metres", "degrees", "allowed"),
    [
        (0.3, 0, "backward left right"),
        (0.3, 30, "backward left right"),
        (0.3, 60, ALL),
        (0.3, 180, "forward left right"),
        (0.5, 0, ALL),
        (0.05, 0, ALL),
    ],
)
def test_motion_is_forbidden_when_an_obstacle_is_near(
    rig: Rig, metres: float, degrees: int, allowed: str
) -> None:
    rig.begun().scan(metres, math.radians(degrees))
    assert rig.ways() == allowed


def test_message_is_refused_and_counted_when_it_is_invalid(rig: Rig) -> None:
    rig.begun()
    before = rig.senses.track.at(rig.clock.now_s)
    rig.clock.now_s += 0.01
    rig.wheels(math.nan)
    rig.wheels(2e6)
    rig.wheels(0.1, at_s=rig.clock.now_s - 0.5)
    for payload in (b"\0\1\0\0" + b"\xff" * 40, b"", bytes(100_000)):
        rig.senses.take(ODOM, payload)
    assert rig.senses.track.at(rig.clock.now_s) == before
    assert rig.senses.refused[ODOM] == 6
    rig.clock.now_s += 0.3  # what is refused is not heard either
    assert "/odom" in str(rig.body.detail()["lacks"])


def test_odometry_begins_anew_with_an_episode_and_never_leaps(rig: Rig) -> None:
    rig.known(10.0, 5.0, math.pi / 2)
    rig.body.begin(BEGIN)
    for k in range(1, 11):
        rig.clock.now_s += 0.1
        rig.wheels(10.0, 5.0 + 0.04 * k, math.pi / 2)
        rig.picture()
    told = rig.body.look(1).odometry
    assert (told.x_m, told.y_m, told.speed_m_s) == pytest.approx((0.4, 0.0, 0.4), abs=1e-9)
    # Its driver was started again, and counts from nothing.
    for x in (0.0, 0.04):
        rig.clock.now_s += 0.1
        rig.wheels(x)
    rig.picture()
    told = rig.body.look(2).odometry
    assert (told.x_m, told.y_m) == pytest.approx((0.44, 0.0), abs=1e-9)
    assert rig.body.detail()["odometry_leaps"] == 1


def test_track_keeps_its_way_when_wheels_restart_after_silence() -> None:
    track = WheelTrack(0.2, 0.6, 0.25)
    track.add(0.0, 1.0, 0.0, 0.0)
    assert track.add(0.5, 1.1, 0.0, 0.3).ahead_m == pytest.approx(0.1, rel=0.05)
    assert track.leaps == 0
    track = WheelTrack(0.2, 0.6, 0.25)
    track.add(0.0, 1.0, 0.0, 0.0)
    before = track.add(1.5, 1.02, 0.0, 0.9)
    assert track.add(2.7, 0.01, 0.0, 0.05)[1:4] == before[1:4]
    assert track.leaps == 1


@given(st.lists(st.tuples(st.floats(-0.1, 0.1), st.floats(-1, 1)), max_size=30), st.floats(-3, 3))
def test_track_is_the_same_when_the_wheels_begin_elsewhere(
    steps: list[tuple[float, float]], turned: float
) -> None:
    one = WheelTrack(1.0, 10.0, 0.25)
    other = WheelTrack(1.0, 10.0, 0.25)
    x = y = heading = 0.0
    told = one.add(0.0, x, y, heading), other.add(0.0, 7.0, -3.0, turned)
    for number, (ahead, turn) in enumerate(steps, 1):
        x = x + ahead * math.cos(heading)
        y = y + ahead * math.sin(heading)
        heading = math.remainder(heading + turn, math.tau)
        cos = math.cos(turned)
        sin = math.sin(turned)
        there = 7.0 + x * cos - y * sin, -3.0 + x * sin + y * cos
        faces = math.remainder(heading + turned, math.tau)
        told = one.add(number / 10, x, y, heading), other.add(number / 10, *there, faces)
    assert (told[0].x_m, told[0].y_m) == pytest.approx((x, y), abs=1e-9)
    assert (told[1].x_m, told[1].y_m) == pytest.approx((x, y), abs=1e-6)


@pytest.mark.parametrize("encoding", ["rgb8", "bgr8", "mono8", "yuv422"])
def test_raw_pixels_are_read(encoding: str) -> None:
    data, step = encoded(PICTURE, encoding)
    fields = {"height": 48, "width": 64, "encoding": encoding, "step": step, "data": data}
    got = decode_jpeg(picture(ROS.read(messages.IMAGE, ROS.write(messages.IMAGE, fields)))).astype(
        int
    )
    assert got.shape == (48, 64, 3)
    if encoding == "mono8":
        assert (
            np.abs(got[..., 0] - cv2.cvtColor(PICTURE, cv2.COLOR_RGB2GRAY).astype(int)).max() < 16
        )
    else:  # yuv422 is 16 to 235 of 0 to 255 where it is taken for video: the middle is what matters
        assert np.corrcoef(got.ravel(), PICTURE.ravel())[0, 1] > 0.95


@pytest.mark.parametrize(
    ("fields", "line"),
    [
        ({"encoding": "32FC1"}, "unsupported encoding '32FC1'; supported are rgb, bgr, rgba"),
        ({"height": 4096}, "pixels in 9216 bytes"),
        ({"width": 0}, "0x48 pixels"),
        ({"step": 3}, "3 per row"),
        ({"width": 2**31, "height": 2**31}, "invalid image"),
    ],
)
def test_image_is_refused_in_one_line_when_it_is_invalid(fields: dict[str, Any], line: str) -> None:
    whole = {"height": 48, "width": 64, "encoding": "rgb8", "step": 192, "data": PICTURE.ravel()}
    with pytest.raises(MessageError, match=line):
        picture(SimpleNamespace(**whole | fields))


def test_body_names_the_missing_topic_when_it_begins(rig: Rig) -> None:
    with pytest.raises(
        ServiceError, match=r"no image received from /camera/\S+; does tcp/.* fit\?$"
    ):
        rig.body.begin(BEGIN)
    rig.picture()
    with pytest.raises(ServiceError, match=r"no message received from /odom; does"):
        rig.body.begin(BEGIN)
    rig.passes(0.01)
    for name, value in {"kidnap_tick": 3, "world": "campus", "variation": "evening"}.items():
        with pytest.raises(ServiceError, match=f"base: {name} {value} is unsupported"):
            check_conditions(rig.body, BEGIN.model_copy(update={name: value}))
    rig.clock.now_s += 1
    with pytest.raises(ServiceError, match=r"the last image of \S+ is 1\.0 s old"):
        rig.body.begin(BEGIN)

"""A broken or malicious robot: whatever comes on its topics is taken or refused, and moves nothing."""

from __future__ import annotations

import math
from contextlib import suppress
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from schemas.base import ATOMS, Message
from schemas.codec import encode
from schemas.image import Image
from services.kit.node import ServiceError
from services.robot.messages import camera_info, imu_message, odometry_message
from services.ros2 import messages
from tests.ros2.rig import STORE, Rig, T, header

HEADER = Message(robot="r", episode="e", tick=0, stamp_ns=0)
NUMBERS = st.floats() | st.floats(-10, 10) | st.sampled_from([0.0, 1e6, -1e6, 1e300, math.inf, math.nan])


def bytes_of(name: str, message: object) -> bytes:
    return bytes(STORE.serialize_cdr(message, name))


@st.composite
def said(draw: st.DrawFn, rig: Rig) -> tuple[str, bytes]:
    """Make a message of some topic: a sane one with some bytes replaced, one of wild numbers, or any bytes."""
    topic = draw(st.sampled_from(sorted(rig.senses.inputs)))
    name = rig.senses.inputs[topic].type_name
    if draw(st.booleans()):
        return topic, draw(st.binary(max_size=300))
    stamp = header(rig.clock.now_s + draw(st.sampled_from([0.0, 0.0, 0.0, 1.0, -1.3, -3.0, 1e6, -1e6])))
    three = T["geometry_msgs/msg/Vector3"](*draw(st.tuples(NUMBERS, NUMBERS, NUMBERS)))
    four = T["geometry_msgs/msg/Quaternion"](*draw(st.tuples(NUMBERS, NUMBERS, NUMBERS, NUMBERS)))
    small, large = st.integers(0, 9), st.integers(0, 2**32 - 1)
    if name == messages.COMPRESSED_IMAGE:
        sides = draw(st.permutations([1 + draw(small), draw(st.sampled_from([1, 3073, 4096, 4097, 65500]))]))
        made = bytes_of(name, T[name](stamp, "", cv2.imencode(".jpg", np.zeros(sides, np.uint8))[1].ravel()))
    elif name == messages.CAMERA_INFO:
        k, region = np.full(9, draw(NUMBERS)), T["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
        told = draw(small | large), draw(small | large)
        made = bytes_of(name, T[name](stamp, *told, "", np.zeros(5), k, np.zeros(9), np.zeros(12), 0, 0, region))
    elif name == messages.ODOMETRY:
        pose = T["geometry_msgs/msg/Pose"](T["geometry_msgs/msg/Point"](three.x, three.y, three.z), four)
        twist = T["geometry_msgs/msg/TwistWithCovariance"](T[messages.TWIST](three, three), np.zeros(36))
        made = bytes_of(name, T[name](stamp, "", T["geometry_msgs/msg/PoseWithCovariance"](pose, np.zeros(36)), twist))
    elif name == messages.IMU:
        made = bytes_of(name, T[name](stamp, four, np.zeros(9), three, np.zeros(9), three, np.zeros(9)))
    elif name == messages.LASER_SCAN:
        ranges = np.asarray(draw(st.lists(st.floats(width=32), max_size=40)) * 9, np.float32)
        limits = draw(st.tuples(*[st.floats(width=32)] * 7))
        made = bytes_of(name, T[name](stamp, *limits, ranges, ranges[:0]))
    else:
        made = bytes_of(messages.BOOL, T[messages.BOOL](draw(st.booleans())))
    at = draw(st.integers(0, len(made)))
    return topic, draw(st.just(made) | st.just(made[:at] + draw(st.binary(max_size=8)) + made[at + 8 :]))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("hostile")


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow], deadline=None)
@given(st.data())
def test_whatever_it_says_there_is_a_frame_that_can_be_sent_and_a_command_that_is_one(
    folder: Path, data: st.DataObject
) -> None:
    rig = Rig(folder, stops=", {topic: button, type: std_msgs/msg/Bool, silence_s: null}")
    rig.says("/button", pressed=False)
    rig.begun()
    for tick in range(data.draw(st.integers(1, 15))):
        rig.clock.now_s += data.draw(st.sampled_from([0.0, 1e-9, 0.01, 0.1, 1.0]))
        rig.senses.take(*data.draw(said(rig)))
        view = rig.body.look(tick)
        assert view.captured_s <= rig.clock.now_s
        height, width, _ = view.image.shape
        Image.after(HEADER, width=width, height=height, data=view.image.tobytes())
        if rig.body.focal_px is not None:
            encode(camera_info(HEADER, view.image, rig.body.focal_px))
        assert view.odometry is not None
        assert view.imu is not None
        encode(odometry_message(HEADER, view.odometry))
        encode(imu_message(HEADER, view.imu))
        rig.body.detail()
        for atom in ATOMS:
            with suppress(ServiceError):
                rig.body.drive(atom, 1.0)
            assert abs(rig.air.sent[-1][0]) <= rig.config.speed_m_s
            stamp_s = rig.air.robot_s
            rig.senses._messages.velocity(*rig.air.sent[-1], None if stamp_s is None else round(stamp_s * 1e9))

"""A broken or malicious robot: its messages are accepted or refused, and move nothing."""

import math
from contextlib import suppress
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from schemas.base import KEYS, Message
from schemas.camera import CompressedImage
from schemas.codec import encode
from services.kit.cameras import camera_info
from services.kit.jpeg import jpeg_size
from services.kit.node import ServiceError
from services.robot.messages import imu_message, odometry_message
from services.ros2 import messages
from tests.ros2.rig import ROS, Rig, header

HEADER = Message(robot="r", episode="e", tick=0, stamp_ns=0)
NUMBERS = (
    st.floats() | st.floats(-10, 10) | st.sampled_from([0.0, 1e6, -1e6, 1e300, math.inf, math.nan])
)
VECTORS = st.fixed_dictionaries(dict.fromkeys("xyz", NUMBERS))
TURNS = st.fixed_dictionaries(dict.fromkeys("xyzw", NUMBERS))
SIZES = st.integers(0, 9) | st.integers(0, 2**32 - 1)
LIMITS = (
    *("angle_min", "angle_max", "angle_increment", "time_increment", "scan_time"),
    *("range_min", "range_max"),
)
SINGLES = st.floats(width=32)
SIDES = st.tuples(st.integers(1, 10), st.sampled_from([1, 3073, 4096, 4097, 65500])).flatmap(
    st.permutations
)
#: By type: fields of wild numbers.
FIELDS: dict[str, st.SearchStrategy[dict[str, Any]]] = {
    messages.COMPRESSED_IMAGE: SIDES.map(
        lambda sides: {"data": cv2.imencode(".jpg", np.zeros(sides, np.uint8))[1].ravel()}
    ),
    messages.CAMERA_INFO: st.fixed_dictionaries(
        {"height": SIZES, "width": SIZES, "k": NUMBERS.map(lambda number: np.full(9, number))}
    ),
    messages.ODOMETRY: st.fixed_dictionaries(
        {
            "pose": st.fixed_dictionaries(
                {"pose": st.fixed_dictionaries({"position": VECTORS, "orientation": TURNS})}
            )
        }
    ),
    messages.IMU: st.fixed_dictionaries(
        {"angular_velocity": VECTORS, "linear_acceleration": VECTORS}
    ),
    messages.LASER_SCAN: st.fixed_dictionaries(
        dict.fromkeys(LIMITS, SINGLES)
        | {"ranges": st.lists(SINGLES, max_size=40).map(lambda ranges: ranges * 9)}
    ),
    messages.HAZARDS: st.lists(st.integers(0, 255), max_size=3).map(
        lambda numbers: {"detections": [{"type": number} for number in numbers]}
    ),
    messages.BOOL: st.booleans().map(lambda pressed: {"data": pressed}),
}


@st.composite
def said(draw: st.DrawFn, rig: Rig) -> tuple[str, bytes]:
    """Make a message of some topic: one of wild numbers, the same with some bytes replaced, or any bytes."""
    topic = draw(st.sampled_from(sorted(rig.senses.inputs)))
    name = rig.senses.inputs[topic].type_name
    if draw(st.booleans()):
        return topic, draw(st.binary(max_size=300))
    at_s = rig.clock.now_s + draw(st.sampled_from([0.0, 0.0, 0.0, 1.0, -1.3, -3.0, 1e6, -1e6]))
    made = ROS.write(
        name, draw(FIELDS[name]) | ({} if name == messages.BOOL else {"header": header(at_s)})
    )
    at = draw(st.integers(0, len(made)))
    return topic, draw(
        st.just(made) | st.just(made[:at] + draw(st.binary(max_size=8)) + made[at + 8 :])
    )


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("hostile")


@settings(
    max_examples=50,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)
@given(st.data())
def test_frame_and_command_are_valid_when_messages_are_hostile(
    folder: Path, data: st.DataObject
) -> None:
    rig = Rig(folder, stops=", {topic: button, type: std_msgs/msg/Bool, silence_s: null}")
    rig.says("/button", data=False)
    rig.begun()
    for tick in range(data.draw(st.integers(1, 15))):
        rig.clock.now_s += data.draw(st.sampled_from([0.0, 1e-9, 0.01, 0.1, 1.0]))
        rig.senses.take(*data.draw(said(rig)))
        view = rig.body.look(tick)
        assert view.captured_s <= rig.clock.now_s
        width, height = jpeg_size(view.jpeg) or (0, 0)
        image = CompressedImage.after(HEADER, width=width, height=height, data=view.jpeg)
        if rig.body.camera is not None:
            encode(camera_info(image, rig.body.camera, image.width, image.height))
        assert view.odometry is not None
        assert view.imu is not None
        encode(odometry_message(HEADER, view.odometry))
        encode(imu_message(HEADER, view.imu))
        rig.body.detail()
        for key in KEYS.values():
            with suppress(ServiceError):
                rig.body.drive(key)
            assert abs(rig.air.sent[-1][0]) <= rig.config.speed_m_s
            stamp_s = rig.air.robot_s
            ROS.velocity(*rig.air.sent[-1], None if stamp_s is None else round(stamp_s * 1e9))

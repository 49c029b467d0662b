"""What viewers draw of a recording: where the robot was, where it believed to be, the camera, the ways and a log."""

import json
import math
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from google.protobuf.descriptor import Descriptor
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass
from mcap.reader import make_reader

from schemas.array import Float32Array
from schemas.base import Message
from schemas.motion import TruePose
from schemas.state import State
from schemas.taught_map import TaughtMap
from schemas.topics import key_of, topic_of
from services.recordings.views import view_key
from tests.places import places
from tests.services.recordings import driven_corridor
from tests.services.recordings.recorded_messages import MODEL, episode
from tests.services.recordings.test_recorder_files import record

LAYOUT = Path(__file__).parents[3] / "deploy" / "foxglove.json"
WORLD = (
    5.0,
    -2.0,
    math.pi / 2,
)  # The true pose is that of the wheels, turned by a quarter and 5 m further.
KEYFRAMES = np.array([[0, 0, 0], [1, 0, 0], [2, 0, 0], [0, 5, 0]], np.float32)


def drive() -> list[Message]:
    """Make a drive with a belief: the robot is half a metre to the left of keyframe 1."""
    told: list[Message] = [driven_corridor.event(0, "started")]
    for tick in range(4):
        here = driven_corridor.header(tick)
        x_m, y_m, heading_rad = driven_corridor.pose(tick)
        told += driven_corridor.told(tick)
        told.append(
            TruePose.after(
                here, x_m=5.0 - y_m, y_m=-2.0 + x_m, heading_rad=heading_rad + math.pi / 2
            )
        )
        if tick == 0:
            told.append(
                TaughtMap.after(
                    here, model=MODEL, keyframes=Float32Array.from_numpy(KEYFRAMES), begins=(0, 3)
                )
            )
        where = places((1, 0.0, 0.5, 0.0, 0.75), (3, 0.25, 0.0, 1.0, 0.25))
        lost = 0.1 if tick < 3 else 0.9
        status = "recognized" if tick < 3 else "unknown"
        told.append(State.after(here, status=status, model=MODEL, places=where, lost=lost))
    return [*told, driven_corridor.event(3, "ended", outcome="found", judge="operator")]


def views_of(path: Path) -> dict[str, list[Any]]:
    """Read as a viewer does: with nothing but the file's own descriptors."""
    found: defaultdict[str, list[Any]] = defaultdict(list)
    with path.open("rb") as file:
        for schema, channel, stored in make_reader(file).iter_messages(log_time_order=False):
            if topic_of(channel.topic) is None:
                message = GetMessageClass(described(schema.data, schema.name)).FromString(
                    stored.data
                )
                found[channel.topic.removeprefix(view_key("teacher", ""))].append(message)
    return found


def described(data: bytes, name: str) -> Descriptor:
    pool = DescriptorPool()
    for descriptor in FileDescriptorSet.FromString(data).file:
        pool.Add(descriptor)
    return pool.FindMessageTypeByName(name)


def planar(position: Any, rotation: Any) -> tuple[float, float, float]:
    assert (position.z, rotation.x, rotation.y) == (0, 0, 0)
    return position.x, position.y, 2.0 * math.atan2(rotation.z, rotation.w)


def transform(message: Any) -> tuple[str, str, tuple[float, float, float]]:
    return (
        message.parent_frame_id,
        message.child_frame_id,
        planar(message.translation, message.rotation),
    )


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return record(tmp_path, drive())


def test_frames_hang_together_and_lie_where_the_robot_was(path: Path) -> None:
    views = views_of(path)
    for tick in range(4):
        parent, child, pose = transform(views["odometry"][tick])
        assert (parent, child) == ("odom", "base_link")
        assert pose == pytest.approx(driven_corridor.pose(tick))
        x_m, y_m, heading_rad = driven_corridor.pose(tick)
        true = views["pose"][tick]
        assert true.frame_id == "world"
        expected = (5.0 - y_m, -2.0 + x_m, heading_rad + math.pi / 2)
        assert planar(true.pose.position, true.pose.orientation) == pytest.approx(expected)
        stamp = true.timestamp.seconds * 10**9 + true.timestamp.nanos
        assert stamp == driven_corridor.header(tick).stamp_ns
    ((parent, child, pose),) = map(transform, views["world"])
    assert (parent, child) == ("world", "odom")
    assert pose == pytest.approx(WORLD)
    (camera,) = views["camera"]
    assert (camera.parent_frame_id, camera.child_frame_id) == ("base_link", "camera")
    assert turned(camera.rotation, (0, 0, 1)) == pytest.approx((1, 0, 0)), "its z looks ahead"
    assert turned(camera.rotation, (1, 0, 0)) == pytest.approx((0, -1, 0)), (
        "its x is to the robot's right"
    )
    (calibration,) = views["calibration"]
    assert (calibration.frame_id, calibration.width, calibration.height) == ("camera", 64, 48)
    assert list(calibration.K) == pytest.approx([44.8, 0, 32, 0, 44.8, 24, 0, 0, 1])


def turned(quaternion: Any, vector: tuple[float, float, float]) -> tuple[float, float, float]:
    x = quaternion.x
    y = quaternion.y
    z = quaternion.z
    w = quaternion.w
    axis = np.array([x, y, z])
    v = np.array(vector, float)
    return tuple((v + 2 * np.cross(axis, np.cross(axis, v) + w * v)).tolist())


def test_views_place_belief_on_routes_and_routes_on_robot(path: Path) -> None:
    views = views_of(path)
    (taught,) = views["taught"]
    (entity,) = taught.entities
    assert entity.frame_id == "map"
    lines = [[(point.x, point.y) for point in line.points] for line in entity.lines]
    assert lines == [[(0, 0), (1, 0), (2, 0)], [(0, 5)]]
    (arrow,) = views["belief"][0].entities[0].arrows
    assert planar(arrow.pose.position, arrow.pose.orientation) == pytest.approx((1.0, 0.5, 0.0))
    assert arrow.color.g == pytest.approx(0.9)
    cloud = views["places"][0]
    points = np.frombuffer(cloud.data, "<f4").reshape(-1, 3)
    np.testing.assert_allclose(points, [[1, 0.5, 0.75], [0.25, 5, 0.25]], atol=1e-6)
    # Seen from the map, the robot is where the belief has it; a robot that is lost goes by its wheels.
    assert len(views["map"]) == 3
    for tick in range(3):
        parent, child, origin = transform(views["map"][tick])
        assert (parent, child) == ("odom", "map")
        x_m, y_m, heading_rad = origin
        cos = math.cos(heading_rad)
        sin = math.sin(heading_rad)
        there = x_m + cos * 1.0 - sin * 0.5, y_m + sin * 1.0 + cos * 0.5
        assert (*there, heading_rad) == pytest.approx(driven_corridor.pose(tick))
    (driven,) = views["driven"]
    points = [(point.x, point.y) for point in driven.entities[0].lines[0].points]
    assert points == [pytest.approx(driven_corridor.pose(tick)[:2]) for tick in range(4)]
    assert isinstance(
        PointCloud.FromString(views["driven_points"][0].SerializeToString()), PointCloud
    )


def test_log_reports_each_change_once(path: Path) -> None:
    told = [(line.name, line.message, line.level) for line in views_of(path)["log"]]
    assert told == [
        ("episode", "drive to end in corridor, seed 0, driver teleop", 2),
        ("robot", "driven by teleop", 2),
        ("recognition", "recognized", 2),
        ("recognition", "unknown", 3),
        ("episode", "ended: found", 2),
    ]


def test_layout_shows_recorded_topics(path: Path, tmp_path: Path) -> None:
    layout = json.loads(LAYOUT.read_text())
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    written = {
        channel.topic.replace("/teacher/", "/rescuebot/") for channel in summary.channels.values()
    }
    panels = layout["configById"]
    assert set(_leaves(layout["layout"])) == panels.keys()
    images = [panel["imageMode"] for name, panel in panels.items() if name.startswith("Image!")]
    named = [*(one["imageTopic"] for one in images), *(one["calibrationTopic"] for one in images)]
    named += [panel["topicToRender"] for name, panel in panels.items() if name.startswith("Log!")]
    named += [
        topic
        for name, panel in panels.items()
        if name.startswith("3D!")
        for topic in panel["topics"]
    ]
    assert set(named) <= written | {"smal/rescuebot/view/tracked"}
    examples = {key_of(one): one for one in episode("e")}
    for value in [
        plot["value"]
        for name, panel in panels.items()
        if name.startswith("Plot!")
        for plot in panel["paths"]
    ]:
        topic, _, fields = value.removeprefix('"').partition('".')
        message: Any = examples[topic].model_json_schema()
        first = fields.partition("[")[0].partition(".")[0]
        assert first in message["properties"], value


def _leaves(node: Any) -> list[str]:
    return [node] if isinstance(node, str) else [*_leaves(node["first"]), *_leaves(node["second"])]

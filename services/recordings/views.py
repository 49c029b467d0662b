"""Drawings for viewers such as Foxglove and Rerun, derived from the recorded messages.

A drawing is written after its message, in the same chunk, under its own key
``smal/ROBOT/view/NAME``. Drawings are never read back: merging and repair derive them again.

Frames follow ROS: ``base_link`` is the robot, ``camera`` its camera, ``odom`` the origin of the
odometry, ``map`` the taught ways, ``world`` the simulator's frame. The belief places ``map`` in
``odom``, so that there is one tree. Messages do not contain the mount of the camera, which is drawn
at the robot's centre.
"""

from collections.abc import Iterator
from functools import singledispatchmethod
from typing import Final, NamedTuple

import numpy as np
from foxglove_schemas_protobuf.ArrowPrimitive_pb2 import ArrowPrimitive
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.Color_pb2 import Color
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.LinePrimitive_pb2 import LinePrimitive
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
from foxglove_schemas_protobuf.Point3_pb2 import Point3
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.Pose_pb2 import Pose as FoxglovePose
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from foxglove_schemas_protobuf.Quaternion_pb2 import Quaternion
from foxglove_schemas_protobuf.SceneEntity_pb2 import SceneEntity
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from foxglove_schemas_protobuf.Vector3_pb2 import Vector3
from google.protobuf.message import Message as ProtobufMessage
from numpy.typing import NDArray

from schemas.action import Action
from schemas.base import Message
from schemas.camera import CameraInfo
from schemas.command import CommandApplied
from schemas.episode import Episode
from schemas.motion import Odometry, TrackedPose, TruePose
from schemas.state import State
from schemas.taught_map import TaughtMap
from schemas.topics import ROOT
from services.recordings.encoding import CAMERA_FRAME, timestamp
from smal.movement import placed, seen_from

_PART: Final = "/view/"
#: Poses by odometry that wait for the belief of their frame, a few frames later.
_KEPT: Final = 100
#: Arrow of the belief, half a metre long like a robot.
_ARROW: Final = {
    "shaft_length": 0.35,
    "shaft_diameter": 0.075,
    "head_length": 0.15,
    "head_diameter": 0.15,
}
_STEP_M: Final = 0.1  # Minimum distance of two points of the driven route.
_MOST_POINTS: Final = 10_000  # Maximum points of a route: more than the resolution of a screen.
_LINE_PX: Final = 3.0
_TAUGHT: Final = Color(r=0.3, g=0.6, b=1.0, a=1.0)
_DRIVEN: Final = Color(r=1.0, g=0.8, b=0.2, a=1.0)
_ORIGIN: Final = np.zeros(3)
Array = NDArray[np.float64]


class RecordedView(NamedTuple):
    """Recorded drawing and its key."""

    name: str
    message: ProtobufMessage


def view_key(robot: str, name: str) -> str:
    """Return the key that a view is written on."""
    return f"{ROOT}/{robot}{_PART}{name}"


def is_view(key: str) -> bool:
    """Return whether a key belongs to a view."""
    return key.startswith(f"{ROOT}/") and _PART in key


class Views:
    """Derives the views of one episode, message by message."""

    def __init__(self) -> None:
        self._wheels: dict[int, Array] = {}
        self._true: dict[int, Array] = {}
        self._with_world = False
        self._keyframes: NDArray[np.float64] | None = None
        self._told: dict[str, object] = {}
        self._way: list[tuple[float, float]] = []
        self._step_m = _STEP_M
        self._began: Message | None = None

    @singledispatchmethod
    def of(self, _message: Message) -> Iterator[RecordedView]:
        """Yield the drawings of a message."""
        yield from ()

    def way(self) -> Iterator[tuple[Message, RecordedView]]:
        """Yield the whole driven route, stamped as the first message to be visible at any time."""
        if self._began is not None and len(self._way) > 1:
            points = np.array([(x_m, y_m, 0.0) for x_m, y_m in self._way])
            for view in _line(self._began, "odom", "driven", [points], _DRIVEN):
                yield self._began, view

    @of.register
    def _odometry(self, odometry: Odometry) -> Iterator[RecordedView]:
        here = np.array(odometry.pose)
        yield RecordedView("odometry", _transform(odometry, "odom", "base_link", here))
        _keep(self._wheels, odometry.tick, here)
        yield from self._world(odometry)
        self._began = self._began or odometry
        if not self._way or float(np.hypot(*(here[:2] - self._way[-1]))) >= self._step_m:
            self._way.append((odometry.x_m, odometry.y_m))
        if len(self._way) > _MOST_POINTS:
            self._way = self._way[::2]
            self._step_m = 2.0 * self._step_m

    @of.register
    def _pose(self, pose: TruePose) -> Iterator[RecordedView]:
        here = np.array(pose.pose)
        yield RecordedView("pose", _in_world(pose, here))
        _keep(self._true, pose.tick, here)
        yield from self._world(pose)

    def _world(self, message: Message) -> Iterator[RecordedView]:
        """Yield once the transform from the world to the frame of the odometry."""
        wheels = self._wheels.get(message.tick)
        true = self._true.get(message.tick)
        if not self._with_world and wheels is not None and true is not None:
            self._with_world = True
            yield RecordedView(
                "world", _transform(message, "world", "odom", _origin_of(true, wheels))
            )

    @of.register
    def _tracked(self, pose: TrackedPose) -> Iterator[RecordedView]:
        if pose.x_m is not None and pose.y_m is not None and pose.heading_rad is not None:
            yield RecordedView(
                "tracked", _in_world(pose, np.array([pose.x_m, pose.y_m, pose.heading_rad]))
            )

    @of.register
    def _camera(self, info: CameraInfo) -> Iterator[RecordedView]:
        focal = info.focal_px
        x = info.centre_x_px
        y = info.centre_y_px
        stamp = timestamp(info.stamp_ns)
        calibration = CameraCalibration(
            timestamp=stamp, frame_id=CAMERA_FRAME, width=info.width, height=info.height
        )
        calibration.K.extend([focal, 0, x, 0, focal, y, 0, 0, 1])
        calibration.distortion_model = info.lens
        calibration.D.extend(info.distortion)
        calibration.R.extend([1, 0, 0, 0, 1, 0, 0, 0, 1])
        calibration.P.extend([focal, 0, x, 0, 0, focal, y, 0, 0, 0, 1, 0])
        yield RecordedView("calibration", calibration)
        # The camera looks ahead: its z is the robot's x, its x the robot's right.
        camera = _transform(info, "base_link", CAMERA_FRAME, _ORIGIN)
        camera.rotation.CopyFrom(Quaternion(x=-0.5, y=0.5, z=-0.5, w=0.5))
        yield RecordedView("camera", camera)

    @of.register
    def _map(self, taught: TaughtMap) -> Iterator[RecordedView]:
        self._keyframes = taught.keyframes.to_numpy().astype(np.float64)
        flat = self._keyframes * (1.0, 1.0, 0.0)
        every = 1 + len(flat) // _MOST_POINTS
        ways = [way[::every] for way in np.split(flat, taught.begins[1:])]
        yield from _line(taught, "map", "taught", ways, _TAUGHT)

    @of.register
    def _state(self, state: State) -> Iterator[RecordedView]:
        yield from self._changed(
            state, "recognition", state.status, warns=state.status == "unknown"
        )
        keyframes = state.keyframes
        if self._keyframes is None or not (keyframes[:1] < len(self._keyframes)).any():
            return
        known = keyframes < len(self._keyframes)
        offsets = state.places.to_numpy()[known, 1:4].astype(np.float64)
        poses = placed(offsets, self._keyframes[keyframes[known]])
        wheels = self._wheels.get(state.tick)
        # A lost robot is drawn at its odometry, if any.
        if wheels is not None and state.status == "recognized":
            yield RecordedView(
                "map", _transform(state, "odom", "map", _origin_of(wheels, poses[0]))
            )
        elif not self._wheels:
            yield RecordedView("map", _transform(state, "map", "base_link", poses[0]))
        color = Color(r=state.lost, g=1.0 - state.lost, b=0.0, a=1.0)
        arrow = ArrowPrimitive(pose=_pose(poses[0]), color=color, **_ARROW)
        yield RecordedView("belief", _scene(state, "map", "belief", SceneEntity(arrows=[arrow])))
        # All places; the height shows the likelihood.
        points = np.column_stack([poses[:, :2], state.weights[known]])
        yield RecordedView("places", _cloud(state, "map", points))

    @of.register
    def _action(self, action: Action) -> Iterator[RecordedView]:
        kind = action.kind.replace("_", " ")
        warns = action.kind in ("dead_end", "look_around", "guess", "blocked", "blind")
        yield from self._changed(action, "policy", kind, warns=warns)

    @of.register
    def _applied(self, applied: CommandApplied) -> Iterator[RecordedView]:
        if applied.source is not None and applied.reason == "command":
            yield from self._changed(applied, "robot", f"driven by {applied.source}")
        else:
            cause = f" ({applied.stop_cause})" if applied.stop_cause else ""
            yield from self._changed(
                applied, "robot", f"stands: {applied.reason}{cause}", warns=True
            )

    @of.register
    def _event(self, event: Episode) -> Iterator[RecordedView]:
        if event.event == "started":
            text = f"{event.purpose} to {event.goal} in {event.world}, seed {event.seed}, driver {event.driver}"
        else:
            text = event.event if event.outcome is None else f"ended: {event.outcome}"
        yield from self._changed(event, "episode", text, warns=event.outcome not in (None, "found"))

    def _changed(
        self, message: Message, name: str, text: str, *, warns: bool = False
    ) -> Iterator[RecordedView]:
        if self._told.get(name) != text:
            self._told[name] = text
            level = Log.WARNING if warns else Log.INFO
            yield RecordedView(
                "log",
                Log(timestamp=timestamp(message.stamp_ns), level=level, message=text, name=name),
            )


def _keep(poses: dict[int, Array], tick: int, pose: Array) -> None:
    poses[tick] = pose
    if len(poses) > _KEPT:
        del poses[next(iter(poses))]


def _origin_of(pose: Array, same: Array) -> Array:
    """Return the origin of the frame in which a pose is the `same`."""
    return placed(seen_from(_ORIGIN, same), pose)


def _quaternion(heading_rad: float) -> Quaternion:
    return Quaternion(z=float(np.sin(heading_rad / 2.0)), w=float(np.cos(heading_rad / 2.0)))


def _pose(pose: Array) -> FoxglovePose:
    x_m, y_m, heading_rad = pose.tolist()
    return FoxglovePose(position=Vector3(x=x_m, y=y_m), orientation=_quaternion(heading_rad))


def _in_world(message: Message, pose: Array) -> PoseInFrame:
    return PoseInFrame(timestamp=timestamp(message.stamp_ns), frame_id="world", pose=_pose(pose))


def _transform(message: Message, parent: str, child: str, pose: Array) -> FrameTransform:
    x_m, y_m, heading_rad = pose.tolist()
    return FrameTransform(
        timestamp=timestamp(message.stamp_ns),
        parent_frame_id=parent,
        child_frame_id=child,
        translation=Vector3(x=x_m, y=y_m),
        rotation=_quaternion(heading_rad),
    )


def _line(
    message: Message, frame: str, name: str, lines: list[Array], color: Color
) -> Iterator[RecordedView]:
    """Yield lines of points (n, 3), and the points for viewers without scenes."""
    drawn = [
        LinePrimitive(
            type=LinePrimitive.LINE_STRIP,
            pose=_pose(_ORIGIN),
            thickness=_LINE_PX,
            scale_invariant=True,
            points=[Point3(x=x, y=y, z=z) for x, y, z in line.tolist()],
            color=color,
        )
        for line in lines
    ]
    yield RecordedView(name, _scene(message, frame, name, SceneEntity(lines=drawn)))
    yield RecordedView(f"{name}_points", _cloud(message, frame, np.concatenate(lines)))


def _scene(message: Message, frame: str, name: str, entity: SceneEntity) -> SceneUpdate:
    entity.timestamp.CopyFrom(timestamp(message.stamp_ns))
    entity.frame_id = frame
    entity.id = name
    entity.frame_locked = True
    return SceneUpdate(entities=[entity])


def _cloud(message: Message, frame: str, points: Array) -> PointCloud:
    kind = PackedElementField.FLOAT32
    fields = [
        PackedElementField(name=name, offset=4 * k, type=kind) for k, name in enumerate("xyz")
    ]
    return PointCloud(
        timestamp=timestamp(message.stamp_ns),
        frame_id=frame,
        pose=_pose(_ORIGIN),
        point_stride=12,
        fields=fields,
        data=points.astype("<f4").tobytes(),
    )

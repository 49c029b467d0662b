"""A robot that speaks ROS 2 over Zenoh, and shares no code with services/ros2: wheels, camera, router, each a process.

``python -m tests.ros2.fake_turtlebot {router,base,camera} OPTIONS``, JSON of `tests.ros2.field.Robot`. It moves and
sees in a world of the simulator. Its wheels have a watchdog, and their odometry drifts; its clock may be off.
"""

import itertools
import json
import math
import struct
import sys
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import xxhash
import zenoh
import zenoh.ext
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from services.kit.ros_message import ros_message
from services.simulator.base import WheelSpeeds, move
from services.simulator.sensors.camera import CameraSettings
from services.simulator.world import load_world
from services.simulator.world.place import Pose
from services.simulator.world.route import obstacles_of
from tests.ros2.truth import Truth

STEP_S = 0.02
WATCHDOG_S = 0.2
HEADER = "std_msgs/Header header\n"
# As https://github.com/ros-drivers/ackermann_msgs has it.
STEERING = "".join(
    f"float32 {name}\n"
    for name in ("steering_angle", "steering_angle_velocity", "speed", "acceleration", "jerk")
)
# As controllers of ros2_control do: a stamped velocity that is older is not carried out.
OLDEST_S = 0.5


def now_s() -> float:
    """Return the seconds of the log, which the tests compare with their own."""
    return time.clock_gettime(time.CLOCK_BOOTTIME)


def opened(mode: str, endpoint: str) -> zenoh.Session:
    config = zenoh.Config()
    config.insert_json5("mode", json.dumps(mode))
    config.insert_json5(
        "listen/endpoints" if mode == "router" else "connect/endpoints", json.dumps([endpoint])
    )
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("timestamping/enabled", "true")  # as rmw_zenoh does
    if mode == "client":
        config.insert_json5("connect/timeout_ms", "-1")
        config.insert_json5("connect/retry", '{"period_init_ms": 100, "period_max_ms": 500}')
    return zenoh.open(config)


class Ros:
    """The robot's side of ROS 2, as it is written down for rmw_zenoh and for zenoh-bridge-ros2dds."""

    def __init__(self, node: str, options: SimpleNamespace) -> None:
        self.session = opened("client", options.endpoint)
        self.options = options
        self.types = get_typestore(Stores.ROS2_HUMBLE if options.humble else Stores.ROS2_JAZZY)
        for name, text in (
            ("irobot_create_msgs/msg/HazardDetection", f"{HEADER}uint8 type"),
            (
                "irobot_create_msgs/msg/HazardDetectionVector",
                f"{HEADER}HazardDetection[] detections",
            ),
            ("ackermann_msgs/msg/AckermannDrive", STEERING),
            ("ackermann_msgs/msg/AckermannDriveStamped", f"{HEADER}AckermannDrive drive"),
        ):
            self.types.register(get_types_from_msg(text, name))
        self.node = node
        self.count = 0
        self.kept: list[Any] = []
        zid = str(self.session.info.zid())
        if options.dialect == "rmw_zenoh":
            self._alive(f"@ros2_lv/0/{zid}/0/0/NN/%/%/{node}")

    def _alive(self, token: str) -> None:
        self.kept.append(self.session.liveliness().declare_token(token))

    def _names(self, kind: str, topic: str, type_name: str) -> tuple[str, str]:
        """Return the key and the token of an endpoint."""
        zid = self.session.info.zid()
        (package, _, name) = type_name.split("/")
        if self.options.dialect != "rmw_zenoh":
            escaped = type_name.replace("/", "§")
            return topic, f"@/{zid}/@ros2_lv/{kind}/{topic.replace('/', '§')}/{escaped}/:::"
        self.count += 1
        digest = (
            "TypeHashNotSupported" if self.options.humble else self.types.hash_rihs01(type_name)
        )
        kept = f"{package}::msg::dds_::{name}_/{digest}"
        mangled = "%" + topic.replace("/", "%")
        return (
            f"0/{topic}/{kept}",
            f"@ros2_lv/0/{zid}/0/{self.count}/{kind}/%/%/{self.node}/{mangled}/{kept}/::,10:,:,:,,",
        )

    def header(self, frame: str) -> dict[str, Any]:
        at = time.time() + self.options.clock_offset
        return {"stamp": {"sec": int(at), "nanosec": int(at % 1 * 1e9)}, "frame_id": frame}

    def publisher(self, topic: str, type_name: str, *, latched: bool = False) -> Any:
        """Return a function that publishes messages; latched (transient local), late subscribers get the last one."""
        key, token = self._names("MP", topic, type_name)
        if latched:
            cached = {"cache": zenoh.ext.CacheConfig(max_samples=1), "publisher_detection": True}
            publisher = zenoh.ext.declare_advanced_publisher(self.session, key, **cached)
        else:
            publisher = self.session.declare_publisher(
                key, congestion_control=zenoh.CongestionControl.DROP
            )
        self._alive(token)
        digest = xxhash.xxh3_128(token.encode()).intdigest()
        gid = struct.pack("<QQ", digest % 2**64, digest >> 64)
        numbers = itertools.count(1)

        def publish(**fields: Any) -> None:
            attachment = None
            if self.options.dialect == "rmw_zenoh":
                values = (zenoh.ext.Int64(next(numbers)), zenoh.ext.Int64(time.time_ns()), gid)
                attachment = zenoh.ext.z_serialize(values)
            message = ros_message(self.types, type_name, fields)
            publisher.put(
                bytes(self.types.serialize_cdr(message, type_name)), attachment=attachment
            )

        return publish

    def subscribe(self, topic: str, type_name: str, take: Any) -> None:
        key, token = self._names("MS", topic, type_name)

        def on_sample(sample: zenoh.Sample) -> None:
            if self.options.dialect == "rmw_zenoh":
                if sample.attachment is None:
                    return  # as rmw_zenoh does
                size = len(sample.attachment.to_bytes())
                assert size == 33, size
            take(self.types.deserialize_cdr(sample.payload.to_bytes(), type_name))

        self.kept.append(self.session.declare_subscriber(key, on_sample))
        self._alive(token)


class Base:
    """Two wheels with a watchdog."""

    def __init__(self, options: SimpleNamespace) -> None:
        self.options = options
        self.world = load_world(options.world)
        self.track_m = self.world.robot.drive.track_m
        self.obstacles = obstacles_of(self.world.place)
        self.truth = Truth(Path(options.truth))
        self.pose = self.world.start
        self.odometry = Pose(0.0, 0.0, 0.0)
        self.rng = np.random.default_rng(1)
        # Its wheels are not quite what it believes: so its odometry drifts.
        self.scale = 1.0 + 0.005 * self.rng.standard_normal(2)
        self.order = (0.0, 0.0, -math.inf)
        self.moves = (0.0, 0.0)
        self.due_s = now_s() + STEP_S

    def take(self, message: Any) -> None:
        twist = getattr(message, "twist", message)
        if twist is not message:
            stamp = message.header.stamp.sec + message.header.stamp.nanosec / 1e9
            if abs(time.time() + self.options.clock_offset - stamp) > OLDEST_S:
                return
        self.order = (float(twist.linear.x), float(twist.angular.z), now_s())
        self.truth["orders"] += 1

    def step(self) -> None:
        ahead, turn, ordered_s = self.order
        if self.due_s - ordered_s > WATCHDOG_S:
            ahead = turn = 0.0
        self.moves = ahead, turn
        half = turn * self.track_m / 2
        errors = 1.0 + 0.03 * self.rng.standard_normal(2)
        wheels = WheelSpeeds(float((ahead - half) * errors[0]), float((ahead + half) * errors[1]))
        there = move(self.pose, wheels, self.track_m, STEP_S)
        if self.obstacles.is_free(there.x, there.y):
            self.pose = there
        else:
            self.truth["collided"] = 1.0
        believed = WheelSpeeds(wheels.left * self.scale[0], wheels.right * self.scale[1])
        self.odometry = move(self.odometry, believed, self.track_m, STEP_S)
        if self.truth["put"] != self.truth["was_put"]:
            self.pose = Pose(self.truth["put_x"], self.truth["put_y"], self.truth["put_heading"])
            self.truth["collided"] = 0.0
        self.truth["was_put"] = self.truth["put"]
        truth = self.truth
        truth["x"] = self.pose.x
        truth["y"] = self.pose.y
        truth["heading"] = self.pose.heading
        truth["ahead_m_s"] = ahead
        truth["turn_rad_s"] = turn
        truth["ordered_s"] = ordered_s
        truth["t_s"] = self.due_s

    def run(self, ros: Ros) -> None:
        ros.subscribe("cmd_vel", f"geometry_msgs/msg/{self.options.twist}", self.take)
        roll = ros.publisher("odom", "nav_msgs/msg/Odometry")
        feel = ros.publisher("imu", "sensor_msgs/msg/Imu")
        warn = ros.publisher("hazard_detection", "irobot_create_msgs/msg/HazardDetectionVector")
        with Path(self.options.log).open("a", buffering=1) as log:
            for number in itertools.count():
                time.sleep(max(0.0, self.due_s - now_s()))
                while self.due_s <= now_s():
                    self.step()
                    log.write(
                        json.dumps(
                            [self.due_s, self.pose.x, self.pose.y, *self.moves, self.order[2]]
                        )
                        + "\n"
                    )
                    self.due_s += STEP_S
                ahead, turn = self.moves
                half = self.odometry.heading / 2
                where = {
                    "position": {"x": self.odometry.x, "y": self.odometry.y},
                    "orientation": {"z": math.sin(half), "w": math.cos(half)},
                }
                speeds = {"linear": {"x": ahead}, "angular": {"z": turn}}
                roll(header=ros.header("odom"), pose={"pose": where}, twist={"twist": speeds})
                feel(
                    header=ros.header("imu_link"),
                    angular_velocity={"z": turn},
                    linear_acceleration={"z": 9.81},
                )
                if number % 2 == 0:
                    found = (
                        [{"header": ros.header("bump"), "type": 1}]
                        if self.truth["collided"]
                        else []
                    )
                    warn(header=ros.header("base_link"), detections=found)


class Noise:
    """Noise in place of a renderer, for tests of the wheels alone."""

    focal_px = 50.0

    def __init__(self, width: int, height: int) -> None:
        self._picture = np.random.default_rng(1).integers(
            0, 256, (height, width, 3), dtype=np.uint8
        )

    def render(self, _pose: Pose) -> np.ndarray:
        return self._picture

    def victim_pixels(self, _pose: Pose) -> float:
        return 0.0


def see(options: SimpleNamespace, ros: Ros) -> None:
    """Send pictures of where the robot truly is, for ever."""
    from services.simulator.scene.rendering import SceneCamera  # noqa: PLC0415 - only the camera needs a renderer

    width, height = options.size
    world = load_world(options.world)
    camera = (
        SceneCamera(world, CameraSettings(width, height))
        if options.renders
        else Noise(width, height)
    )
    truth = Truth(Path(options.truth))
    raw = options.encoding != "jpeg"
    show = ros.publisher(
        "camera/image_raw" if raw else "camera/image_raw/compressed",
        "sensor_msgs/msg/Image" if raw else "sensor_msgs/msg/CompressedImage",
    )
    tell = ros.publisher("camera/camera_info", "sensor_msgs/msg/CameraInfo")
    focal = camera.focal_px
    due_s = now_s()
    for number in itertools.count():
        time.sleep(max(0.0, due_s - now_s()))
        due_s = max(due_s + 1.0 / options.rate, now_s())
        header = ros.header("camera")
        pose = Pose(truth["x"], truth["y"], truth["heading"])
        image = camera.render(pose)
        near = math.hypot(world.victim.x - pose.x, world.victim.y - pose.y) <= world.scale.found_m
        truth["victim"] = camera.victim_pixels(pose) if near else 0.0
        size = {"height": height, "width": width}
        if raw:
            rows, step = encoded(image, options.encoding)
            show(header=header, **size, encoding=options.encoding, step=step, data=rows)
        else:
            _, jpeg = cv2.imencode(
                ".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, 85]
            )
            show(header=header, format="rgb8; jpeg compressed bgr8", data=jpeg.ravel())
        truth["frames"] += 1
        if number % options.rate == 0:
            tell(
                header=header,
                **size,
                d=[],
                k=[focal, 0.0, width / 2, 0.0, focal, height / 2, 0.0, 0.0, 1.0],
            )


def encoded(image: np.ndarray, encoding: str) -> tuple[np.ndarray, int]:
    """Return the bytes of an RGB image in another encoding, with a few bytes after each row, and how many a row has."""
    if encoding == "yuv422":
        yuv = cv2.cvtColor(image, cv2.COLOR_RGB2YUV).astype(np.int32)
        pairs = (yuv[:, 0::2, 1:] + yuv[:, 1::2, 1:]) // 2
        rows = np.stack([pairs[..., 0], yuv[:, 0::2, 0], pairs[..., 1], yuv[:, 1::2, 0]], axis=-1)
    else:
        rows = {
            "rgb8": image,
            "bgr8": image[..., ::-1],
            "mono8": cv2.cvtColor(image, cv2.COLOR_RGB2GRAY),
        }[encoding]
    flat = np.asarray(rows, dtype=np.uint8).reshape(image.shape[0], -1)
    padded = np.pad(flat, ((0, 0), (0, 4)))
    return padded.ravel(), padded.shape[1]


def main() -> None:
    part = sys.argv[1]
    options = SimpleNamespace(**json.loads(sys.argv[2]))
    if part == "router":
        session = opened("router", options.endpoint)
        while True:
            time.sleep(1.0)
            session.info.zid()
    ros = Ros(part, options)
    if part == "base":
        Base(options).run(ros)
    see(options, ros)


if __name__ == "__main__":
    main()

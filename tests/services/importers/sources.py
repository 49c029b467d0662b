"""One drive along the painted corridor, as each format has it, written by the formats' own libraries."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from services.kit.jpeg import encode_jpeg
from tests import corridor

#: Of the drive: ahead, to the left on the spot, to the right on the spot, ahead; seconds, metres and radians a second.
LEGS: Final = ((1.5, 2.0, 0.0), (0.4, 0.0, 0.8), (0.4, 0.0, -0.8), (1.0, 2.0, 0.0))
START_S: Final = 1_700_000_000.0


class Moment(NamedTuple):
    """What is so at one time of the drive."""

    time_s: float
    pose: corridor.Pose
    linear: float
    angular: float

    @property
    def image(self) -> NDArray[np.uint8]:
        """What the camera sees."""
        return corridor.view(*self.pose)


def drive(rate_hz: float = 20.0) -> list[Moment]:
    """Return the drive at a rate; at its end the robot stands."""
    moments = []
    pose, time_s = (0.0, 0.0, 0.0), 0.0
    for seconds, linear, angular in LEGS:
        for _ in range(round(seconds * rate_hz)):
            moments.append(Moment(START_S + time_s, pose, linear, angular))
            x, y, heading = pose
            ahead = linear / rate_hz
            pose = (x + ahead * math.cos(heading), y + ahead * math.sin(heading), heading + angular / rate_hz)
            time_s += 1.0 / rate_hz
    return [*moments, Moment(START_S + time_s, pose, 0.0, 0.0)]


def donkeycar(
    folder: Path, rate_hz: float = 20.0, change: Callable[[dict[str, Any]], object] = lambda _record: None,
    deleted: tuple[int, ...] = (), announced: int | None = None,
) -> Path:  # fmt: skip
    """Write a tub; nothing of this is done by donkeycar itself, whose package needs TensorFlow."""
    (folder / "images").mkdir(parents=True)
    lines = []
    for index, moment in enumerate(drive(rate_hz)):
        name = f"{index}_cam_image_array_.jpg"
        (folder / "images" / name).write_bytes(encode_jpeg(moment.image))
        # A car turns only while it drives: on the spot it would have to be pushed.
        record: dict[str, Any] = {
            "_index": index, "_timestamp_ms": round(1000 * moment.time_s), "cam/image_array": name,
            "user/angle": -1.0 if moment.angular > 0 else float(moment.angular < 0),
            "user/throttle": 0.3 if moment.angular else moment.linear / 4.0, "user/mode": "user",
        }  # fmt: skip
        change(record)
        lines.append(json.dumps(record))
    (folder / "catalog_0.catalog").write_text("\n".join(lines) + "\n")
    count = len(lines) if announced is None else announced
    last = {"paths": ["catalog_0.catalog"], "current_index": count, "max_len": 1000, "deleted_indexes": list(deleted)}
    manifest = [["cam/image_array", "user/angle", "user/throttle"], ["image_array", "float", "float"], {}, {}, last]
    (folder / "manifest.json").write_text("\n".join(map(json.dumps, manifest)) + "\n")
    return folder


def csv_folder(folder: Path, rate_hz: float = 20.0, *, poses: bool = True, png: bool = False) -> Path:
    """Write a folder of images and a drive.csv."""
    import cv2  # noqa: PLC0415

    folder.mkdir(parents=True)
    columns = ["time_s", "image", "linear_m_s", "angular_rad_s"] + (["x_m", "y_m", "heading_rad"] if poses else [])
    with (folder / "drive.csv").open("w", newline="") as file:
        table = csv.writer(file)
        table.writerow(columns)
        for number, moment in enumerate(drive(rate_hz)):
            name = f"{number:04d}.{'png' if png else 'jpg'}"
            data = cv2.imencode(".png", moment.image[..., ::-1])[1].tobytes() if png else encode_jpeg(moment.image)
            (folder / name).write_bytes(data)
            table.writerow([moment.time_s, name, moment.linear, moment.angular, *(moment.pose if poses else ())])
    return folder


def lerobot(folder: Path, version: str = "v3.0", *, video: bool = True, episodes: int = 2, fps: int = 20) -> Path:
    """Write a LeRobotDataset of a LeKiwi, whose turn rate is in degrees a second."""
    import pyarrow as pa  # noqa: PLC0415
    import pyarrow.parquet as pq  # noqa: PLC0415

    key, moments = "observation.images.front", drive(fps)
    (folder / "meta").mkdir(parents=True)
    names = ["arm_wrist.pos", "x.vel", "y.vel", "theta.vel"]
    info = {
        "codebase_version": version, "fps": fps, "chunks_size": 1000, "total_episodes": episodes,
        "features": {
            "action": {"dtype": "float32", "shape": [4], "names": names},
            key: {"dtype": "video" if video else "image", "shape": [48, 64, 3], "names": None},
        },
    }  # fmt: skip
    (folder / "meta/info.json").write_text(json.dumps(info))
    rows: list[dict[str, Any]] = []
    for episode in range(episodes):
        for number, moment in enumerate(moments):
            action = [0.5, moment.linear, 0.0, math.degrees(moment.angular)]
            row: dict[str, Any] = {"action": action, "timestamp": number / fps, "episode_index": episode}
            rows.append(row | ({} if video else {key: {"bytes": encode_jpeg(moment.image), "path": None}}))
    pixels = [moment.image for moment in moments]

    def table(path: str, content: list[dict[str, Any]]) -> None:
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        pq.write_table(pa.Table.from_pylist(content), folder / path)

    if version == "v3.0":
        table("data/chunk-000/file-000.parquet", rows)
        described = [
            {
                "episode_index": episode, "length": len(moments), "data/chunk_index": 0, "data/file_index": 0,
                f"videos/{key}/chunk_index": 0, f"videos/{key}/file_index": 0,
                f"videos/{key}/from_timestamp": episode * len(moments) / fps,
            }
            for episode in range(episodes)
        ]  # fmt: skip
        table("meta/episodes/chunk-000/file-000.parquet", described)
        if video:
            mp4(folder / f"videos/{key}/chunk-000/file-000.mp4", pixels * episodes, fps)
    else:
        lines = [json.dumps({"episode_index": episode, "length": len(moments)}) for episode in range(episodes)]
        (folder / "meta/episodes.jsonl").write_text("\n".join(lines) + "\n")
        for episode in range(episodes):
            mine = [row for row in rows if row["episode_index"] == episode]
            table(f"data/chunk-000/episode_{episode:06d}.parquet", mine)
            if video:
                mp4(folder / f"videos/chunk-000/{key}/episode_{episode:06d}.mp4", pixels, fps)
    return folder


def mp4(path: Path, images: list[NDArray[np.uint8]], fps: int) -> None:
    """Write a video, with key frames far apart, as LeRobot's are two frames apart."""
    import av  # noqa: PLC0415

    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=fps, options={"crf": "12", "g": "30"})
        stream.height, stream.width = images[0].shape[:2]
        stream.pix_fmt = "yuv420p"
        for image in images:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        container.mux(stream.encode())


def rosbag2(
    folder: Path, *, sqlite: bool = False, raw: str | None = None, stamped: bool = False, odometry: bool = True,
    command: bool = True, packed: bool = False, hundredths: int | None = None,
) -> Path:  # fmt: skip
    """Write a bag: images at 20 Hz, commands at 10 Hz beside them, odometry at 50 Hz, the camera's calibration."""
    from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer  # noqa: PLC0415
    from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415

    store = get_typestore(Stores.ROS2_HUMBLE)
    writer = Writer(folder, version=9, storage_plugin=StoragePlugin.SQLITE3 if sqlite else StoragePlugin.MCAP)
    if packed:
        writer.set_compression(CompressionMode.MESSAGE if sqlite else CompressionMode.STORAGE, CompressionFormat.ZSTD)
    with writer:
        image_type = "sensor_msgs/msg/Image" if raw else "sensor_msgs/msg/CompressedImage"
        twist_type = "geometry_msgs/msg/TwistStamped" if stamped else "geometry_msgs/msg/Twist"
        kinds = {"/camera/image": image_type, "/camera/camera_info": "sensor_msgs/msg/CameraInfo",
                 "/cmd_vel": twist_type, "/odom": "nav_msgs/msg/Odometry"}  # fmt: skip
        left_out = {"/odom": not odometry, "/cmd_vel": not command}
        kinds = {topic: kind for topic, kind in kinds.items() if not left_out.get(topic)}
        channels = {topic: writer.add_connection(topic, kind, typestore=store) for topic, kind in kinds.items()}
        messages = _Messages(store.types)
        #: Every so many hundredths of a second, beginning when, and what.
        said: dict[str, tuple[int, int, Callable[[Moment], Any]]] = {
            "/camera/image": (5, 0, partial(messages.image, raw=raw)),
            "/cmd_vel": (10, 3, partial(messages.twist, stamped=stamped)),
            "/odom": (2, 0, messages.odometry),
            "/camera/camera_info": (10**9, 0, messages.info),
        }
        for number, moment in enumerate(drive(100.0)[:hundredths]):
            for topic, channel in channels.items():
                period, first, make = said[topic]
                if number % period == first:
                    data = store.serialize_cdr(make(moment), kinds[topic])
                    writer.write(channel, round(moment.time_s * 1e9), data)
    return folder


class _Messages:
    """Makes ROS messages."""

    def __init__(self, types: dict[str, Any]) -> None:
        self._types = types

    def _new(self, package: str, name: str, **fields: object) -> Any:
        return self._types[f"{package}/msg/{name}"](**fields)

    def header(self, moment: Moment | None = None) -> Any:
        stamp = self._new("builtin_interfaces", "Time", sec=0, nanosec=0)
        return self._new("std_msgs", "Header", stamp=stamp, frame_id="base" if moment is None else "odom")

    def image(self, moment: Moment, raw: str | None) -> Any:
        pixels = moment.image
        if raw is None:
            data = np.frombuffer(encode_jpeg(pixels), np.uint8)
            return self._new("sensor_msgs", "CompressedImage", header=self.header(), format="jpeg", data=data)
        data = in_encoding(pixels, raw)
        return self._new(
            "sensor_msgs", "Image", header=self.header(), height=48, width=64, encoding=raw, is_bigendian=0,
            step=data.size // 48, data=data,
        )  # fmt: skip

    def _vector(self, x: float = 0.0, z: float = 0.0) -> Any:
        return self._new("geometry_msgs", "Vector3", x=x, y=0.0, z=z)

    def twist(self, moment: Moment, *, stamped: bool = False) -> Any:
        twist = self._new(
            "geometry_msgs", "Twist", linear=self._vector(x=moment.linear), angular=self._vector(z=moment.angular)
        )
        return self._new("geometry_msgs", "TwistStamped", header=self.header(), twist=twist) if stamped else twist

    def odometry(self, moment: Moment) -> Any:
        # A robot that was somewhere else before, and looked elsewhere.
        x, y, heading = moment.pose
        turned = 2.0
        place = self._new(
            "geometry_msgs", "Point", x=5.0 + x * math.cos(turned) - y * math.sin(turned),
            y=-3.0 + x * math.sin(turned) + y * math.cos(turned), z=0.0,
        )  # fmt: skip
        half = (heading + turned) / 2.0
        turn = self._new("geometry_msgs", "Quaternion", x=0.0, y=0.0, z=math.sin(half), w=math.cos(half))
        pose = self._new("geometry_msgs", "Pose", position=place, orientation=turn)
        none = np.zeros(36)
        return self._new(
            "nav_msgs", "Odometry", header=self.header(moment), child_frame_id="base",
            pose=self._new("geometry_msgs", "PoseWithCovariance", pose=pose, covariance=none),
            twist=self._new("geometry_msgs", "TwistWithCovariance", twist=self.twist(moment), covariance=none),
        )  # fmt: skip

    def info(self, _moment: Moment) -> Any:
        region = self._new(
            "sensor_msgs", "RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
        )
        matrix = np.array([45.0, 0.0, 32.0, 0.0, 45.0, 24.0, 0.0, 0.0, 1.0])
        return self._new(
            "sensor_msgs", "CameraInfo", header=self.header(), height=48, width=64, distortion_model="plumb_bob",
            d=np.zeros(5), k=matrix, r=np.eye(3).ravel(), p=np.zeros(12), binning_x=0, binning_y=0, roi=region,
        )  # fmt: skip


def in_encoding(pixels: NDArray[np.uint8], encoding: str) -> NDArray[np.uint8]:
    """Return RGB pixels as ROS has them in an encoding, with two bytes of padding in each row."""
    import cv2  # noqa: PLC0415

    height = len(pixels)
    if encoding == "yuv422":
        y, u, v = np.moveaxis(cv2.cvtColor(pixels, cv2.COLOR_RGB2YUV), -1, 0)
        packed = np.stack([u[:, ::2], y[:, ::2], v[:, ::2], y[:, 1::2]], axis=-1)
    else:
        packed = {
            "rgb8": lambda: pixels,
            "bgr8": lambda: pixels[..., ::-1],
            "mono8": lambda: cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY),
        }[encoding]()
    rows = packed.reshape(height, -1)
    return np.ascontiguousarray(np.pad(rows, ((0, 0), (0, 2)))).ravel()

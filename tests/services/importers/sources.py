"""One drive along the painted corridor, as each format has it, written by the formats' own libraries."""

import csv
import json
import math
import shutil
from collections.abc import Callable
from datetime import datetime
from functools import wraps
from hashlib import sha256
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from services.kit.jpeg import encode_jpeg
from services.kit.ros_message import ros_message
from tests import corridor

#: Parts of the drive: ahead, to the left on the spot, to the right on the spot, ahead; seconds,
#: metres and radians a second.
LEGS: Final = ((1.5, 2.0, 0.0), (0.4, 0.0, 0.8), (0.4, 0.0, -0.8), (1.0, 2.0, 0.0))
START_S: Final = 1_700_000_000.0
CAMERA: Final = "observation.images.front"
#: Angle and throttle of a car for each movement. It turns only while it drives.
KEYS_OF_CAR: Final = {
    "forward": (0.0, 0.5),
    "backward": (0.0, -0.5),
    "left": (-1.0, 0.3),
    "right": (1.0, 0.3),
    "stop": (0.0, 0.0),
}


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

    @property
    def atom(self) -> str:
        """Movement from this time on."""
        if self.angular:
            return "left" if self.angular > 0 else "right"
        return "forward" if self.linear else "stop"


def drive(rate_hz: float = 20.0) -> list[Moment]:
    """Return the drive at a rate; at its end the robot stands."""
    moments = []
    pose = (0.0, 0.0, 0.0)
    time_s = 0.0
    for seconds, linear, angular in LEGS:
        for _ in range(round(seconds * rate_hz)):
            moments.append(Moment(START_S + time_s, pose, linear, angular))
            x, y, heading = pose
            ahead = linear / rate_hz
            pose = (
                x + ahead * math.cos(heading),
                y + ahead * math.sin(heading),
                heading + angular / rate_hz,
            )
            time_s += 1.0 / rate_hz
    return [*moments, Moment(START_S + time_s, pose, 0.0, 0.0)]


Writes = Callable[..., Path]


def made_once(write: Writes) -> Writes:
    """Have each source be written once, and copied from then on."""
    home = TemporaryDirectory()

    @wraps(write)
    def copied(folder: Path, *how: Any, **options: Any) -> Path:
        if "change" in options:
            return write(folder, *how, **options)
        # A bag has the name of its folder.
        template = Path(home.name, sha256(repr((how, options)).encode()).hexdigest(), folder.name)
        if not template.exists():
            write(template, *how, **options)
        return shutil.copytree(template, folder)

    return copied


@made_once
def donkeycar(
    folder: Path, rate_hz: float = 20.0, change: Callable[[dict[str, Any]], object] = lambda _record: None,
    deleted: tuple[int, ...] = (), announced: int | None = None,
) -> Path:  # fmt: skip
    """Write a tub; nothing of this is done by donkeycar itself, whose package needs TensorFlow."""
    moments = drive(rate_hz)
    frames = [(one.time_s, encode_jpeg(one.image), KEYS_OF_CAR[one.atom]) for one in moments]
    return write_tub(folder, frames, change, deleted, announced)


def write_tub(
    folder: Path,
    frames: list[tuple[float, bytes, tuple[float, float]]],
    change: Callable[[dict[str, Any]], object] = lambda _record: None,
    deleted: tuple[int, ...] = (),
    announced: int | None = None,
) -> Path:
    """Write a tub of frames: time, JPEG, angle and throttle."""
    (folder / "images").mkdir(parents=True)
    lines = []
    for index, (time_s, jpeg, (angle, throttle)) in enumerate(frames):
        name = f"{index}_cam_image_array_.jpg"
        (folder / "images" / name).write_bytes(jpeg)
        record: dict[str, Any] = {
            "_index": index,
            "_timestamp_ms": round(1000 * time_s),
            "cam/image_array": name,
            "user/angle": angle,
            "user/throttle": throttle,
            "user/mode": "user",
        }
        change(record)
        lines.append(json.dumps(record))
    (folder / "catalog_0.catalog").write_text("\n".join(lines) + "\n")
    count = len(lines) if announced is None else announced
    last = {
        "paths": ["catalog_0.catalog"],
        "current_index": count,
        "max_len": 1000,
        "deleted_indexes": list(deleted),
    }
    manifest = [
        ["cam/image_array", "user/angle", "user/throttle"],
        ["image_array", "float", "float"],
        {},
        {},
        last,
    ]
    (folder / "manifest.json").write_text("\n".join(map(json.dumps, manifest)) + "\n")
    return folder


@made_once
def first_tub(folder: Path, rate_hz: float = 20.0, *, time: str = "milliseconds") -> Path:
    """Write a tub of version 1, with a date, milliseconds or no time in each record."""
    folder.mkdir(parents=True)
    inputs = ["cam/image_array", "user/angle", "user/throttle", "user/mode"]
    meta = {"inputs": inputs, "types": ["image_array", "float", "float", "str"]}
    (folder / "meta.json").write_text(json.dumps(meta))
    for index, moment in enumerate(drive(rate_hz), 1):
        name = f"{index}_cam-image_array_.jpg"
        (folder / name).write_bytes(encode_jpeg(moment.image))
        values = [name, *KEYS_OF_CAR[moment.atom], "user"]
        times = {
            "milliseconds": round(1000 * (moment.time_s - START_S)),
            "timestamp": str(datetime.fromtimestamp(moment.time_s)),
        }
        record = dict(zip(inputs, values, strict=True)) | {time: times.get(time)}
        (folder / f"record_{index}.json").write_text(json.dumps(record))
    return folder


@made_once
def csv_folder(
    folder: Path, rate_hz: float = 20.0, *, poses: bool = True, png: bool = False
) -> Path:
    """Write a folder of images and a drive.csv."""
    folder.mkdir(parents=True)
    columns = ["time_s", "image", "linear_m_s", "angular_rad_s"] + (
        ["x_m", "y_m", "heading_rad"] if poses else []
    )
    with (folder / "drive.csv").open("w", newline="") as file:
        table = csv.writer(file)
        table.writerow(columns)
        for number, moment in enumerate(drive(rate_hz)):
            name = f"{number:04d}.{'png' if png else 'jpg'}"
            data = (
                cv2.imencode(".png", moment.image[..., ::-1])[1].tobytes()
                if png
                else encode_jpeg(moment.image)
            )
            (folder / name).write_bytes(data)
            table.writerow(
                [
                    moment.time_s, name, moment.linear, moment.angular,
                    *(moment.pose if poses else ()),
                ]
            )  # fmt: skip
    return folder


@made_once
def lerobot(
    folder: Path, version: str = "v3.0", *, video: bool = True, episodes: int = 2, fps: int = 20
) -> Path:
    """Write a LeRobotDataset of a LeKiwi, whose turn rate is in degrees a second."""
    moments = drive(fps)
    (folder / "meta").mkdir(parents=True)
    names = ["arm_wrist.pos", "x.vel", "y.vel", "theta.vel"]
    info = {
        "codebase_version": version, "fps": fps, "chunks_size": 1000, "total_episodes": episodes,
        "features": {
            "action": {"dtype": "float32", "shape": [4], "names": names},
            CAMERA: {"dtype": "video" if video else "image", "shape": [48, 64, 3], "names": None},
        },
    }  # fmt: skip
    (folder / "meta/info.json").write_text(json.dumps(info))
    rows = _rows(moments, episodes, fps, video=video)
    pixels = [moment.image for moment in moments]
    if version == "v3.0":
        _table(folder / "data/chunk-000/file-000.parquet", rows)
        described = [
            {
                "episode_index": episode, "length": len(moments), "data/chunk_index": 0, "data/file_index": 0,
                f"videos/{CAMERA}/chunk_index": 0, f"videos/{CAMERA}/file_index": 0,
                f"videos/{CAMERA}/from_timestamp": episode * len(moments) / fps,
            }
            for episode in range(episodes)
        ]  # fmt: skip
        _table(folder / "meta/episodes/chunk-000/file-000.parquet", described)
        if video:
            mp4(folder / f"videos/{CAMERA}/chunk-000/file-000.mp4", pixels * episodes, fps)
        return folder
    lines = [
        json.dumps({"episode_index": episode, "length": len(moments)})
        for episode in range(episodes)
    ]
    (folder / "meta/episodes.jsonl").write_text("\n".join(lines) + "\n")
    for episode in range(episodes):
        mine = [row for row in rows if row["episode_index"] == episode]
        _table(folder / f"data/chunk-000/episode_{episode:06d}.parquet", mine)
        if video:
            mp4(folder / f"videos/chunk-000/{CAMERA}/episode_{episode:06d}.mp4", pixels, fps)
    return folder


def _rows(moments: list[Moment], episodes: int, fps: int, *, video: bool) -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = []
    for episode in range(episodes):
        for number, moment in enumerate(moments):
            row: dict[str, Any] = {
                "action": [0.5, moment.linear, 0.0, math.degrees(moment.angular)],
                "timestamp": number / fps,
                "episode_index": episode,
            }
            if not video:
                row[CAMERA] = {"bytes": encode_jpeg(moment.image), "path": None}
            rows.append(row)
    return rows


def _table(path: Path, content: list[dict[str, Any]]) -> None:
    import pyarrow as pa  # noqa: PLC0415
    import pyarrow.parquet as pq  # noqa: PLC0415

    path.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(pa.Table.from_pylist(content), path)


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


@made_once
def rosbag2(
    folder: Path, *, sqlite: bool = False, raw: str | None = None, stamped: bool = False, odometry: bool = True,
    command: bool = True, packed: bool = False, hundredths: int | None = None, suffix: str = ".jpg",
) -> Path:  # fmt: skip
    """Write a bag: images at 20 Hz, commands at 10 Hz beside them, odometry at 50 Hz, the camera's calibration."""
    from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer  # noqa: PLC0415
    from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415

    store = get_typestore(Stores.ROS2_HUMBLE)
    folder.parent.mkdir(parents=True, exist_ok=True)
    writer = Writer(
        folder, version=9, storage_plugin=StoragePlugin.SQLITE3 if sqlite else StoragePlugin.MCAP
    )
    if packed:
        writer.set_compression(
            CompressionMode.MESSAGE if sqlite else CompressionMode.STORAGE, CompressionFormat.ZSTD
        )
    #: By topic: the type, every so many hundredths of a second, beginning when, and what.
    said: dict[str, tuple[str, int, int, Callable[[Moment], dict[str, Any]]]] = {
        "/camera/image": (
            "sensor_msgs/msg/CompressedImage",
            5,
            0,
            lambda moment: _compressed(moment, suffix),
        ),
        "/camera/camera_info": ("sensor_msgs/msg/CameraInfo", 10**9, 0, _info),
        "/cmd_vel": ("geometry_msgs/msg/Twist", 10, 3, _twist),
        "/odom": ("nav_msgs/msg/Odometry", 2, 0, _odometry),
    }
    if raw is not None:
        said["/camera/image"] = "sensor_msgs/msg/Image", 5, 0, lambda moment: _raw(moment, raw)
    if stamped:
        said["/cmd_vel"] = (
            "geometry_msgs/msg/TwistStamped",
            10,
            3,
            lambda moment: {"twist": _twist(moment)},
        )
    for topic, there in (("/cmd_vel", command), ("/odom", odometry)):
        if not there:
            del said[topic]
    with writer:
        channels = {
            topic: writer.add_connection(topic, kind, typestore=store)
            for topic, (kind, *_) in said.items()
        }
        for number, moment in enumerate(drive(100.0)[:hundredths]):
            for topic, (kind, period, first, make) in said.items():
                if number % period == first:
                    data = store.serialize_cdr(ros_message(store, kind, make(moment)), kind)
                    writer.write(channels[topic], round(moment.time_s * 1e9), data)
    return folder


def _compressed(moment: Moment, suffix: str) -> dict[str, Any]:
    """Return an image as a file of a format, or as ROS compresses depth."""
    data = encode_jpeg(moment.image)
    form = "jpeg"
    if suffix == "rvl":
        data = bytes(200)
        form = "16UC1; compressedDepth rvl"
    elif suffix == "depth":
        depth_mm = cv2.cvtColor(moment.image, cv2.COLOR_RGB2GRAY).astype(np.uint16) * 16
        data = bytes(12) + cv2.imencode(".png", depth_mm)[1].tobytes()
    elif suffix != ".jpg":
        data = cv2.imencode(suffix, moment.image[..., ::-1])[1].tobytes()
    return {"format": form, "data": np.frombuffer(data, np.uint8)}


def _raw(moment: Moment, encoding: str) -> dict[str, Any]:
    data = in_encoding(moment.image, encoding)
    return {"height": 48, "width": 64, "encoding": encoding, "step": data.size // 48, "data": data}


def _twist(moment: Moment) -> dict[str, Any]:
    return {"linear": {"x": moment.linear}, "angular": {"z": moment.angular}}


def _odometry(moment: Moment) -> dict[str, Any]:
    # A robot that was somewhere else before, and looked elsewhere.
    x, y, heading = moment.pose
    turned = 2.0
    place = {
        "x": 5.0 + x * math.cos(turned) - y * math.sin(turned),
        "y": -3.0 + x * math.sin(turned) + y * math.cos(turned),
    }
    half = (heading + turned) / 2.0
    pose = {"position": place, "orientation": {"z": math.sin(half), "w": math.cos(half)}}
    return {"pose": {"pose": pose}, "twist": {"twist": _twist(moment)}}


def _info(_moment: Moment) -> dict[str, Any]:
    return {"height": 48, "width": 64, "k": [45.0, 0.0, 32.0, 0.0, 45.0, 20.0, 0.0, 0.0, 1.0]}


def in_encoding(pixels: NDArray[np.uint8], encoding: str) -> NDArray[np.uint8]:
    """Return RGB pixels as ROS has them in an encoding, with two bytes of padding in each row."""
    if encoding == "yuv422":
        y, u, v = np.moveaxis(cv2.cvtColor(pixels, cv2.COLOR_RGB2YUV), -1, 0)
        packed = np.stack([u[:, ::2], y[:, ::2], v[:, ::2], y[:, 1::2]], axis=-1)
    elif encoding in ("mono8", "32FC1"):
        packed = cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY)
    else:
        packed = pixels if encoding == "rgb8" else pixels[..., ::-1]
    return np.ascontiguousarray(np.pad(packed.reshape(len(pixels), -1), ((0, 0), (0, 2)))).ravel()

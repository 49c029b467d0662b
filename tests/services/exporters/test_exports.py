"""Every format holds the drive that was put in, and gives it back to ``smal import``."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from schemas.base import ATOMS
from services.exporters.drives import ExportFailure, Nominal, read
from services.exporters.job import FORMATS, write
from services.importers.drive import ImportFailure, Tally
from services.kit.jpeg import encode_jpeg
from services.recordings.encoding import stamped_jpeg
from services.recordings.recorded import RecordedEpisode
from tests import corridor
from tests.services.exporters.recorded_drive import (
    FOCAL_PX,
    MADE,
    SPEED,
    START_NS,
    TURN_RATE,
    atoms_of,
    episode_of,
    poses,
    recording,
)
from tests.services.importers import sources
from tests.services.importers.test_formats import imported

pytest.importorskip("rosbags", reason="needs the extra formats")


def exported(
    files: Sequence[Path], form: Any, folder: Path, speed: float | None = None, turn_rate: float | None = None
) -> tuple[Nominal, Tally]:
    tally = Tally()
    drives = read(files, speed, turn_rate, tally)
    folder.mkdir(parents=True)
    write(form, drives, folder, tally)
    return drives[0].nominal, tally


def brought_back(source: Path, form: str, folder: Path, **fields: object) -> RecordedEpisode:
    report, _ = imported(source, form, folder, **fields)
    (file,) = report.files
    return episode_of(Path(file))


def jpegs(episode: RecordedEpisode) -> dict[int, bytes]:
    return {tick: stamped_jpeg(bytes(payload))[1] for tick, payload in episode.images.items()}


def check_way(episode: RecordedEpisode, within: float, without: Collection[int] = ()) -> None:
    for tick, pose in episode.odometry.items():
        if tick not in without:
            assert pose == pytest.approx(poses()[tick], abs=within)


def content(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("form", ["rosbag2", "folder"])
def test_what_is_imported_again_is_the_same_drive(form: str, tmp_path: Path) -> None:
    """Images to the byte, every movement, where the wheels were, and ticks that were lost."""
    file = recording(tmp_path / "recordings", lost=range(9, 13))
    exported([file], form, tmp_path / "out")
    back = brought_back(tmp_path / "out" / ("drive" if form == "rosbag2" else ""), form, tmp_path / "back")
    was = episode_of(file)
    # What was nearer to a frame than an eighth of a second shows that.
    assert set(back.images) - set(was.images) <= {9, 12}
    assert {tick: jpeg for tick, jpeg in jpegs(back).items() if tick in was.images} == jpegs(was)
    assert {tick: atom for tick, atom in atoms_of(back).items() if tick in was.images} == {
        tick: atom for tick, atom in atoms_of(was).items() if tick in was.images
    }
    assert len(back.odometry) == len(back.images)
    check_way(back, 1e-5, without={9, 12} if form == "folder" else ())
    assert back.outcome == "found"
    assert back.focal == (pytest.approx(FOCAL_PX / 64) if form == "rosbag2" else None)


def test_a_data_set_that_is_imported_again_is_the_same_drives(tmp_path: Path) -> None:
    """All but what the video lost: movements, the way, who arrived; a gap makes two drives of one."""
    files = [
        recording(tmp_path / "recordings", "whole"),
        recording(tmp_path / "recordings", "failed", outcome="timeout"),
        recording(tmp_path / "recordings", "torn", lost=[10]),
    ]
    _, tally = exported(files, "lerobot", tmp_path / "set")
    assert "1 gaps are the end of an episode and the beginning of another" in tally.lines()
    assert "the camera's field of view has no place in it; import it with --field-of-view 71.08" in tally.lines()
    report, said = imported(tmp_path / "set", "lerobot", tmp_path / "back")
    assert report.odometry == "of the source"
    assert not said.lines()
    episodes = {int(Path(file).name.partition("-")[0]): episode_of(Path(file)) for file in report.files}
    assert [episodes[number].outcome for number in range(4)] == ["found", "aborted", "aborted", "found"]
    assert [len(episodes[number].images) for number in range(4)] == [len(MADE), len(MADE), 10, len(MADE) - 11]
    assert list(atoms_of(episodes[0]).values()) == list(MADE)
    assert list(atoms_of(episodes[3]).values()) == list(MADE[11:])
    check_way(episodes[0], 1e-5)


@pytest.mark.parametrize("form", FORMATS)
def test_the_same_export_has_the_same_bytes(form: str, tmp_path: Path) -> None:
    files = [recording(tmp_path / "recordings", name) for name in ("one", "two")]
    for folder in ("first", "again"):
        exported(files, form, tmp_path / folder / "out")
    assert content(tmp_path / "first") == content(tmp_path / "again") != {}


@pytest.mark.parametrize("share", [1.0, 0.5])
def test_velocities_are_measured_by_the_wheels(share: float, tmp_path: Path) -> None:
    """Of full speed, also where it was driven at half of it."""
    nominal, _ = exported([recording(tmp_path / "recordings", share=share)], "folder", tmp_path / "out")
    assert nominal.speed == (pytest.approx(SPEED, rel=1e-4), "by its odometry")
    assert nominal.turn_rate == (pytest.approx(TURN_RATE, rel=1e-4), "by its odometry")
    rows = (tmp_path / "out" / "drive.csv").read_text().splitlines()[1:]
    assert {float(row.split(",")[3]) for row in rows} == {share * SPEED, -share * SPEED, 0.0}


def test_a_turn_that_went_ahead_is_exported_so(tmp_path: Path) -> None:
    """A car's: at 0.6 of its speed straight on."""
    report, _ = imported(sources.donkeycar(tmp_path / "tub"), "donkeycar", tmp_path / "recordings")
    exported([Path(report.files[0])], "folder", tmp_path / "out", speed=2.0, turn_rate=1.0)
    rows = [line.split(",") for line in (tmp_path / "out" / "drive.csv").read_text().splitlines()]
    at = [rows[0].index(name) for name in ("linear_m_s", "angular_rad_s")]
    velocities = {tuple(round(float(row[k]), 4) for k in at) for row in rows[1:]}
    assert velocities == {(2.0, 0.0), (1.2, 1.0), (1.2, -1.0), (0.0, 0.0)}


def test_without_odometry_velocities_are_what_the_user_says(tmp_path: Path) -> None:
    file = recording(tmp_path / "recordings", odometry=False)
    with pytest.raises(ExportFailure, match="episode drive: no odometry says how fast forward is; say it with --speed"):
        exported([file], "rosbag2", tmp_path / "none")
    with pytest.raises(ExportFailure, match="no odometry says how fast left is; say it with --turn-rate"):
        exported([file], "rosbag2", tmp_path / "none", speed=0.5)
    nominal, tally = exported([file], "rosbag2", tmp_path / "out", speed=0.5, turn_rate=1.0)
    assert (nominal.speed.origin, nominal.turn_rate.origin) == ("as --speed says", "as --turn-rate says")
    assert "1 drives have no odometry: nothing moves in a 3D view" in tally.lines()
    back = brought_back(tmp_path / "out/drive", "rosbag2", tmp_path / "back")
    assert list(atoms_of(back).values()) == list(MADE)
    assert back.odometry[8][0] == pytest.approx(0.4)


def test_drives_with_and_without_odometry_are_in_one_folder_and_one_data_set(tmp_path: Path) -> None:
    files = [recording(tmp_path / "recordings", name, odometry=name == "with") for name in ("with", "without")]
    exported(files, "folder", tmp_path / "folder")
    report, _ = imported(tmp_path / "folder", "folder", tmp_path / "back", reckon=False)
    assert [bool(episode_of(Path(file)).odometry) for file in report.files] == [True, False]
    _, tally = exported(files, "lerobot", tmp_path / "set")
    assert f"{len(MADE)} of {2 * len(MADE)} frames lack odometry: there is no observation.state" in tally.lines()


def test_each_robot_has_its_own_velocities_and_each_drive_a_name(tmp_path: Path) -> None:
    files = [recording(tmp_path / robot, robot=robot, share=share) for robot, share in (("slow", 0.5), ("fast", 1.0))]
    tally = Tally()
    slow, fast = read(files, 1.0, None, tally)
    assert (slow.name, fast.name) == ("slow-drive", "fast-drive")
    assert tally.lines() == []


# ---------------------------------------------------------------- rosbag2


def bag_of(folder: Path) -> list[tuple[str, str, int, Any]]:
    """Return topic, type, time and message of everything in a bag, by its owners' reader."""
    from rosbags.highlevel import AnyReader  # noqa: PLC0415

    with AnyReader([folder]) as bag:
        return [
            (connection.topic, connection.msgtype, stamp_ns, bag.deserialize(data, connection.msgtype))
            for connection, stamp_ns, data in bag.messages()
        ]


def test_a_bag_has_what_a_robot_would_have_sent(tmp_path: Path) -> None:
    file = recording(tmp_path / "recordings")
    exported([file], "rosbag2", tmp_path / "out")
    said = bag_of(tmp_path / "out/drive")
    frames = len(MADE)
    assert Counter((topic, kind) for topic, kind, _, _ in said) == {
        ("/camera/image_raw/compressed", "sensor_msgs/msg/CompressedImage"): frames,
        ("/camera/camera_info", "sensor_msgs/msg/CameraInfo"): frames,
        ("/odom", "nav_msgs/msg/Odometry"): frames,
        ("/tf", "tf2_msgs/msg/TFMessage"): frames,
        ("/tf_static", "tf2_msgs/msg/TFMessage"): 1,
        ("/cmd_vel", "geometry_msgs/msg/TwistStamped"): frames,
        ("/imu", "sensor_msgs/msg/Imu"): 2 * (frames - 1),
    }
    for topic, _, stamp_ns, message in said:
        stamps = [one.header.stamp for one in message.transforms] if topic.startswith("/tf") else [message.header.stamp]
        assert [one.sec * 10**9 + one.nanosec for one in stamps] == [stamp_ns]
    by_topic = {topic: [message for name, _, _, message in said if name == topic] for topic, *_ in said}
    at_ns = [stamp_ns for topic, _, stamp_ns, _ in said if topic == "/odom"]
    assert at_ns == [START_NS + 10**8 * tick for tick in range(frames)]
    images = jpegs(episode_of(file))
    each = (by_topic[topic] for topic in ("/camera/image_raw/compressed", "/odom", "/tf", "/cmd_vel"))
    for tick, (image, odometry, moved, command) in enumerate(zip(*each, strict=True)):
        x, y, heading = poses()[tick]
        assert (image.data.tobytes(), image.format) == (images[tick], "jpeg")
        (transform,) = moved.transforms
        assert (transform.header.frame_id, transform.child_frame_id) == ("odom", "base_link")
        assert (odometry.header.frame_id, odometry.child_frame_id) == ("odom", "base_link")
        for place, turn in (
            (odometry.pose.pose.position, odometry.pose.pose.orientation),
            (transform.transform.translation, transform.transform.rotation),
        ):
            assert (place.x, place.y, place.z) == (x, y, 0.0)
            assert (turn.z, turn.w) == (math.sin(heading / 2), math.cos(heading / 2))
        assert (odometry.twist.twist.linear.x, odometry.twist.twist.angular.z) == (1.5, 0.25)
        sign = {"forward": (1, 0), "backward": (-1, 0), "left": (0, 1), "right": (0, -1), "stop": (0, 0)}[MADE[tick]]
        assert command.twist.linear.x == pytest.approx(sign[0] * SPEED)
        assert command.twist.angular.z == pytest.approx(sign[1] * TURN_RATE, abs=1e-4)
    info = by_topic["/camera/camera_info"][0]
    assert (info.k[0], info.k[4], info.k[2], info.k[5], info.width, info.height) == (44.8, 44.8, 32.0, 24.0, 64, 48)
    imu = by_topic["/imu"][0]
    assert (imu.linear_acceleration.z, imu.angular_velocity.z, imu.orientation_covariance[0]) == (9.81, 0.06, -1.0)


def test_the_camera_of_a_bag_looks_ahead_of_the_robot(tmp_path: Path) -> None:
    """What is ahead of the camera, its z, is ahead of the robot, its x; what is right of it, its x, is -y."""
    exported([recording(tmp_path / "recordings")], "rosbag2", tmp_path / "out")
    ((_, _, _, fixed),) = (one for one in bag_of(tmp_path / "out/drive") if one[0] == "/tf_static")
    (transform,) = fixed.transforms
    assert (transform.header.frame_id, transform.child_frame_id) == ("base_link", "camera_optical_frame")
    turn = transform.transform.rotation
    x, y, z, w = turn.x, turn.y, turn.z, turn.w
    axes = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
    np.testing.assert_allclose(axes, [[0, 0, 1], [-1, 0, 0], [0, -1, 0]], atol=1e-12)


def test_a_bag_can_be_sought_in_and_says_of_what_drive_it_is(tmp_path: Path) -> None:
    from mcap.reader import make_reader  # noqa: PLC0415
    from ruamel.yaml import YAML  # noqa: PLC0415

    exported([recording(tmp_path / "recordings")], "rosbag2", tmp_path / "out")
    described = YAML(typ="safe").load(tmp_path / "out/drive/metadata.yaml")["rosbag2_bagfile_information"]
    assert described["storage_identifier"] == "mcap"
    said = {"robot": "rescuebot", "episode": "drive", "goal": "dock", "outcome": "found"}
    assert described["custom_data"] | {f"smal.{key}": value for key, value in said.items()} == described["custom_data"]
    (fixed,) = (
        one["topic_metadata"]
        for one in described["topics_with_message_count"]
        if one["topic_metadata"]["name"] == "/tf_static"
    )
    assert fixed["offered_qos_profiles"][0]["durability"] == "transient_local"
    (name,) = described["relative_file_paths"]
    with (tmp_path / "out/drive" / name).open("rb") as file:
        reader = make_reader(file)
        summary = reader.get_summary()
        assert reader.get_header().profile == "ros2"
        assert summary is not None
        assert {schema.encoding for schema in summary.schemas.values()} == {"ros2msg"}
        late = list(reader.iter_messages(starting_at=START_NS + 25 * 10**8))
        assert {message.log_time for *_, message in late} >= {START_NS + 26 * 10**8}
        assert summary.statistics is not None
        assert summary.statistics.message_count == described["message_count"]


def test_a_time_that_ros_cannot_say_is_one_line(tmp_path: Path) -> None:
    file = recording(tmp_path / "recordings", start_ns=5 * 10**18)
    with pytest.raises(ExportFailure, match="a time 5000000000 s after 1970, which ROS cannot say"):
        exported([file], "rosbag2", tmp_path / "out")


# ---------------------------------------------------------------- lerobot


def rows_of(path: Path) -> dict[str, list[Any]]:
    import pyarrow.parquet as pq  # noqa: PLC0415

    table: dict[str, list[Any]] = pq.read_table(path).to_pydict()
    return table


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Make a data set of two drives, 29 and 29 frames."""
    folder = tmp_path_factory.mktemp("lerobot")
    exported([recording(folder / "recordings", name) for name in ("one", "two")], "lerobot", folder / "set")
    return folder / "set"


def test_a_data_set_has_the_files_and_columns_of_lerobot(dataset: Path) -> None:
    """As lerobot 0.4 writes them: it refuses rows with a column more or less than the description has."""
    key = "observation.images.front"
    assert set(content(dataset)) == {
        "meta/info.json", "meta/stats.json", "meta/tasks.parquet", "meta/episodes/chunk-000/file-000.parquet",
        "data/chunk-000/file-000.parquet", f"videos/{key}/chunk-000/file-000.mp4",
    }  # fmt: skip
    info = json.loads((dataset / "meta/info.json").read_text())
    frames = len(MADE)
    assert (info["codebase_version"], info["fps"], info["total_episodes"]) == ("v3.0", 10, 2)
    assert (info["total_frames"], info["total_tasks"], info["splits"]) == (2 * frames, 1, {"train": "0:2"})
    rows = rows_of(dataset / info["data_path"].format(chunk_index=0, file_index=0))
    assert set(rows) == set(info["features"]) - {key}
    assert info["features"][key]["shape"] == [48, 64, 3]
    assert rows["index"] == list(range(2 * frames))
    assert rows["frame_index"] == [*range(frames)] * 2
    assert rows["episode_index"] == [0] * frames + [1] * frames
    assert rows["task_index"] == [0] * (2 * frames)
    np.testing.assert_allclose(rows["timestamp"], np.array(rows["frame_index"]) / 10, atol=1e-6)
    assert [at for at, arrived in enumerate(rows["next.success"]) if arrived] == [frames - 1, 2 * frames - 1]
    np.testing.assert_allclose(rows["observation.state"][:frames], poses(), atol=1e-5)
    episodes = rows_of(dataset / "meta/episodes/chunk-000/file-000.parquet")
    assert episodes["length"] == [frames, frames]
    assert episodes["tasks"] == [["Go to the dock."]] * 2
    assert (episodes["dataset_from_index"], episodes["dataset_to_index"]) == ([0, frames], [frames, 2 * frames])
    assert episodes[f"videos/{key}/from_timestamp"] == [0.0, frames / 10]
    assert episodes[f"videos/{key}/to_timestamp"] == [frames / 10, 2 * frames / 10]
    for column in ("data", f"videos/{key}", "meta/episodes"):
        assert (episodes[f"{column}/chunk_index"], episodes[f"{column}/file_index"]) == ([0, 0], [0, 0])


def test_the_column_types_of_a_data_set_are_those_that_it_describes(dataset: Path) -> None:
    import pyarrow.parquet as pq  # noqa: PLC0415

    features = json.loads((dataset / "meta/info.json").read_text())["features"]
    schema = pq.read_schema(dataset / "data/chunk-000/file-000.parquet")
    for name in schema.names:
        kind, shape = features[name]["dtype"], features[name]["shape"]
        arrow = {"float32": "float", "int64": "int64", "bool": "bool"}[kind]
        wanted = arrow if shape == [1] else f"fixed_size_list<element: {arrow}>[{shape[0]}]"
        assert str(schema.field(name).type).replace("item:", "element:") == wanted


def test_the_tasks_of_a_data_set_are_the_index_that_pandas_makes_of_them(dataset: Path) -> None:
    import pyarrow.parquet as pq  # noqa: PLC0415

    table = pq.read_table(dataset / "meta/tasks.parquet")
    assert table.to_pydict() == {"task_index": [0], "task": ["Go to the dock."]}
    assert json.loads(table.schema.metadata[b"pandas"])["index_columns"] == ["task"]


def test_the_video_of_a_data_set_shows_every_frame_at_its_time(dataset: Path) -> None:
    """Within the tolerance of lerobot, 1e-4 s; each is nearer to its view than to any other."""
    av = pytest.importorskip("av")
    with av.open(str(dataset / "videos/observation.images.front/chunk-000/file-000.mp4")) as video:
        frames = [(float(frame.time), frame.to_ndarray(format="rgb24")) for frame in video.decode(video=0)]
        stream = video.streams.video[0]
        assert (stream.codec.canonical_name, stream.pix_fmt, stream.base_rate) == ("h264", "yuv420p", 10)
    assert len(frames) == 2 * len(MADE)
    views = np.stack([corridor.view(*pose) for pose in poses()]).astype(float)
    for number, (time_s, pixels) in enumerate(frames):
        assert time_s == pytest.approx(number / 10, abs=1e-4)
        off = np.abs(views - pixels).mean(axis=(1, 2, 3))
        assert off[number % len(MADE)] < min(off.min() + 0.5, 10.0)


def test_the_statistics_of_a_data_set_are_those_of_its_values(dataset: Path) -> None:
    stats = json.loads((dataset / "meta/stats.json").read_text())
    rows = rows_of(dataset / "data/chunk-000/file-000.parquet")
    assert set(stats) == set(json.loads((dataset / "meta/info.json").read_text())["features"])
    for key in ("action", "observation.state", "timestamp", "next.success"):
        values = np.array(rows[key], dtype=float).reshape(len(rows[key]), -1)
        assert stats[key]["count"] == [len(values)]
        for name in ("min", "max", "mean", "std"):
            np.testing.assert_allclose(stats[key][name], getattr(values, name)(axis=0))
        np.testing.assert_allclose(stats[key]["q10"], np.quantile(values, 0.1, axis=0))
    from services.kit.jpeg import decode_jpeg  # noqa: PLC0415

    pixels = np.stack([decode_jpeg(encode_jpeg(corridor.view(*pose))) for pose in poses()]) / 255.0
    image = stats["observation.images.front"]
    for name in ("min", "max", "mean", "std"):
        np.testing.assert_allclose(np.reshape(image[name], 3), getattr(pixels, name)(axis=(0, 1, 2)), atol=1e-9)
        assert np.shape(image[name]) == (3, 1, 1)
    np.testing.assert_allclose(np.reshape(image["q50"], 3), np.median(pixels, axis=(0, 1, 2)), atol=1 / 255)
    episodes = rows_of(dataset / "meta/episodes/chunk-000/file-000.parquet")
    assert episodes["stats/action/max"][0] == stats["action"]["max"]
    np.testing.assert_allclose(episodes["stats/observation.images.front/mean"][1], image["mean"])


def test_poses_of_a_data_set_that_are_none_are_one_line(tmp_path: Path) -> None:
    import pyarrow as pa  # noqa: PLC0415
    import pyarrow.parquet as pq  # noqa: PLC0415

    exported([recording(tmp_path / "recordings")], "lerobot", tmp_path / "set")
    path = tmp_path / "set/data/chunk-000/file-000.parquet"
    rows = pq.read_table(path).to_pylist()
    for change, said in (
        (
            lambda row: row | {"observation.state": [1.0]},
            "observation.state has fewer numbers than meta/info.json names",
        ),
        (lambda row: row | {"observation.state": "here"}, "observation.state is not a column of numbers"),
        (
            lambda row: {key: row[key] for key in row if key != "observation.state"},
            "lacks the column observation.state",
        ),
    ):
        pq.write_table(pa.Table.from_pylist([change(row) for row in rows]), path)
        with pytest.raises(ImportFailure, match=said):
            imported(tmp_path / "set", "lerobot", tmp_path / "back")


def test_large_videos_are_several_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("services.exporters.lerobot._VIDEO_MB", 0)
    monkeypatch.setattr("services.exporters.lerobot._CHUNK", 2)
    files = [recording(tmp_path / "recordings", name) for name in ("a", "b", "c")]
    exported(files, "lerobot", tmp_path / "set")
    videos = sorted(str(path.relative_to(tmp_path / "set")) for path in (tmp_path / "set").rglob("*.mp4"))
    folder = "videos/observation.images.front"
    assert videos == [f"{folder}/{at}.mp4" for at in ("chunk-000/file-000", "chunk-000/file-001", "chunk-001/file-000")]
    report, _ = imported(tmp_path / "set", "lerobot", tmp_path / "back")
    for file in report.files:
        assert list(atoms_of(episode_of(Path(file))).values()) == list(MADE)


def test_images_that_a_video_has_no_room_for_are_said(tmp_path: Path) -> None:
    odd = {tick: encode_jpeg(np.zeros((49, 65, 3), np.uint8)) for tick in range(len(MADE))}
    with pytest.raises(ExportFailure, match="images of 65x49 pixels: a video has an even number of columns and rows"):
        exported([recording(tmp_path / "odd", jpeg=odd)], "lerobot", tmp_path / "none")
    files = [recording(tmp_path / "recordings", f"scale-{scale}", scale=scale) for scale in (1, 2)]
    _, tally = exported(files, "lerobot", tmp_path / "set")
    assert f"{len(MADE)} images have another size than the first, and are left out" in tally.lines()


# ---------------------------------------------------------------- what does not fit


@pytest.mark.parametrize("form", FORMATS)
def test_damaged_images_are_counted(form: str, tmp_path: Path) -> None:
    file = recording(tmp_path / "recordings", jpeg={3: b"GIF89a", 4: b"\xff\xd8\xff\xd9"})
    _, tally = exported([file], form, tmp_path / "out")
    assert tally.counts["images are damaged"] == 2


@pytest.mark.parametrize("form", ["folder", "lerobot"])
def test_a_frame_without_a_movement_is_counted(form: str, tmp_path: Path) -> None:
    """Of a recorder that was killed the last frame does not tell what was done then; it is no arrival either."""
    file = recording(tmp_path / "recordings", outcome=None)
    _, tally = exported([file], form, tmp_path / "out")
    assert "1 frames do not tell what was done then, and are left out" in tally.lines()
    assert f"{file}: truncated; the {len(MADE)} whole frames are read" in tally.lines()
    back = brought_back(tmp_path / "out", form, tmp_path / "back")
    assert (len(back.images), back.outcome) == (len(MADE) - 1, "aborted")


def test_a_recording_without_images_is_named(tmp_path: Path) -> None:
    file = recording(tmp_path / "recordings", images=False)
    with pytest.raises(ExportFailure, match="holds no camera frame"):
        exported([file], "folder", tmp_path / "out")


def test_what_cannot_be_read_is_said_and_the_rest_exported(tmp_path: Path) -> None:
    whole = recording(tmp_path / "recordings")
    copy = tmp_path / "copy.mcap"
    copy.write_bytes(whole.read_bytes())
    noise = tmp_path / "noise.mcap"
    noise.write_bytes(np.random.default_rng(1).bytes(1000))
    _, tally = exported([noise, whole, copy], "folder", tmp_path / "out")
    assert tally.lines()[:2] == [
        f"{noise}: not an MCAP file", f"{copy}: episode drive is left out: it is in {whole} too",
    ]  # fmt: skip
    assert len(list((tmp_path / "out/drive").iterdir())) == len(MADE)


def test_every_atom_has_a_velocity() -> None:
    assert set(MADE) == set(ATOMS)

"""Every format holds the drive that was put in, and gives it back to ``smal import``."""

import json
import math
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

from services.exporters.drives import FORMATS, NominalSpeeds, read, write
from services.importers.drive import Tally
from services.kit.cameras import camera_of
from services.kit.errors import JobError
from services.kit.jpeg import decode_jpeg, encode_jpeg
from services.recordings.encoding import stamped_jpeg
from services.recordings.recorded import RecordedEpisode
from tests import corridor
from tests.services.exporters.recorded_drive import (
    MADE,
    SPEED,
    START_NS,
    TURN_RATE,
    atoms_of,
    poses,
    recording,
)
from tests.services.importers import sources
from tests.services.importers.test_formats import episode_of, imported

pytest.importorskip("rosbags", reason="needs the extra formats")
CAMERA = "observation.images.front"
FRAMES = len(MADE)
GAP = range(9, 13)  # Ticks without an image
LOST_IN_VIDEO = 6.0
"""Grey levels of 255, on average over an image; the images of two ticks differ by more."""


def exported(
    files: Sequence[Path],
    form: Any,
    folder: Path,
    speed: float | None = None,
    turn_rate: float | None = None,
) -> tuple[NominalSpeeds, Tally]:
    tally = Tally()
    drives = read(files, speed, turn_rate, tally)
    folder.mkdir(parents=True)
    write(form, drives, folder, tally)
    return drives[0].nominal, tally


def brought_back(source: Path, form: str, folder: Path, **fields: object) -> list[RecordedEpisode]:
    report, _ = imported(source, form, folder, **fields)
    return [episode_of(file) for file in report.files]


def jpegs(episode: RecordedEpisode) -> dict[int, bytes]:
    return {tick: stamped_jpeg(bytes(payload))[1] for tick, payload in episode.images.items()}


def tub_of(file: Path, folder: Path) -> Path:
    """Write a recording as a tub. SMAL does not export tubs."""
    was = episode_of(file)
    made = atoms_of(was)
    frames = [
        ((START_NS + 10**8 * tick) / 1e9, jpeg, sources.KEYS_OF_CAR[made[tick]])
        for tick, jpeg in jpegs(was).items()
    ]
    return sources.write_tub(folder, frames)


class Kept(NamedTuple):
    """The parts of a drive that a format keeps."""

    source: str = ""  # Path in the exported folder
    gaps: bool = True  # Otherwise another episode begins after a gap
    image_bytes: bool = True
    calibration: bool = False
    odometry: bool = True


KEPT = {
    "rosbag2": Kept(source="drive", calibration=True),
    "lerobot": Kept(gaps=False, image_bytes=False),
    "donkeycar": Kept(odometry=False),
    "folder": Kept(),
}


def from_first(episode: RecordedEpisode, ticks: list[int]) -> NDArray[np.float64]:
    """Return the poses at ticks in the frame of the first pose."""
    x, y, heading = np.array([episode.odometry[tick].pose for tick in ticks]).T
    place = (x - x[0] + 1j * (y - y[0])) * np.exp(-1j * heading[0])
    return np.stack([place.real, place.imag, heading - heading[0]], axis=1)


def check_piece(was: RecordedEpisode, back: RecordedEpisode, ticks: list[int], kept: Kept) -> None:
    """Check frames, times, movements and poses at ticks of the recorded drive."""
    begin = 0 if kept.gaps else ticks[0]
    there = [tick - begin for tick in ticks]
    # An empty tick at the border of a gap shows the nearest frame.
    assert set(back.images) - set(there) <= {GAP[0], GAP[-1]}
    for tick in ticks:
        jpeg = jpegs(was)[tick]
        again = jpegs(back)[tick - begin]
        off = np.abs(decode_jpeg(jpeg) - decode_jpeg(again).astype(float)).mean()
        assert jpeg == again if kept.image_bytes else off < LOST_IN_VIDEO
    times_ns = [stamped_jpeg(bytes(back.images[tick]))[0] for tick in there]
    np.testing.assert_allclose(np.diff(times_ns), 10**8 * np.diff(ticks), atol=1e3)
    made = [back.applied[tick].atom for tick in there[:-1]]
    assert made == [MADE[tick] for tick in ticks[:-1]]
    if kept.odometry:
        np.testing.assert_allclose(from_first(back, there), from_first(was, ticks), atol=1e-5)
    else:
        assert not back.odometry


@pytest.mark.parametrize("form", KEPT)
def test_drive_is_unchanged_when_exported_and_imported(form: str, tmp_path: Path) -> None:
    kept = KEPT[form]
    file = recording(tmp_path / "recordings", lost=GAP)
    if form == "donkeycar":
        tub_of(file, tmp_path / "out")
    else:
        exported([file], form, tmp_path / "out")
    was = episode_of(file)
    back = brought_back(tmp_path / "out" / kept.source, form, tmp_path / "back")
    pieces = [[*was.images]] if kept.gaps else [piece.tolist() for piece in was.pieces()]
    for episode, ticks in zip(back, pieces, strict=True):
        check_piece(was, episode, ticks, kept)
    arrival = back[-1]
    assert arrival.outcome == was.outcome
    assert arrival.is_goal(max(arrival.images))
    calibration = arrival.camera and camera_of(arrival.camera)
    assert calibration == (camera_of(was.camera) if kept.calibration else None)


def test_dataset_splits_drive_when_ticks_are_missing(tmp_path: Path) -> None:
    files = [
        recording(tmp_path / "recordings", "failed", outcome="timeout"),
        recording(tmp_path / "recordings", "torn", lost=[10]),
    ]
    _, tally = exported(files, "lerobot", tmp_path / "set")
    assert "1 gaps split an episode" in tally.lines()
    assert (
        "the format cannot store the camera's field of view; import it with --field-of-view 81.86"
        in tally.lines()
    )
    back = brought_back(tmp_path / "set", "lerobot", tmp_path / "back")
    assert [episode.outcome for episode in back] == ["aborted", "aborted", "found"]
    assert [len(episode.images) for episode in back] == [FRAMES, 10, FRAMES - 11]


@pytest.mark.parametrize("form", FORMATS)
def test_export_is_identical_when_repeated(form: str, tmp_path: Path) -> None:
    files = [recording(tmp_path / "recordings", name) for name in ("one", "two")]
    first = files_of(files, form, tmp_path / "first")
    assert first
    assert first == files_of(files, form, tmp_path / "again")


def files_of(files: Sequence[Path], form: str, folder: Path) -> dict[Path, bytes]:
    """Return the exported files without videos, whose encoder may vary."""
    exported(files, form, folder)
    return {
        path.relative_to(folder): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file() and path.suffix != ".mp4"
    }


@pytest.mark.parametrize("share", [1.0, 0.5])
def test_velocities_are_measured_by_the_wheels(share: float, tmp_path: Path) -> None:
    nominal, _ = exported(
        [recording(tmp_path / "recordings", share=share)], "folder", tmp_path / "out"
    )
    assert nominal.speed == (pytest.approx(SPEED, rel=1e-4), "by odometry")
    assert nominal.turn_rate == (pytest.approx(TURN_RATE, rel=1e-4), "by odometry")
    rows = (tmp_path / "out" / "drive.csv").read_text().splitlines()[1:]
    assert {float(row.split(",")[3]) for row in rows} == {share * SPEED, -share * SPEED, 0.0}


def test_export_keeps_forward_speed_of_turns(tmp_path: Path) -> None:
    report, _ = imported(sources.donkeycar(tmp_path / "tub"), "donkeycar", tmp_path / "recordings")
    exported([Path(report.files[0])], "folder", tmp_path / "out", speed=2.0, turn_rate=1.0)
    rows = [line.split(",") for line in (tmp_path / "out" / "drive.csv").read_text().splitlines()]
    at = [rows[0].index(name) for name in ("linear_m_s", "angular_rad_s")]
    velocities = {tuple(round(float(row[k]), 4) for k in at) for row in rows[1:]}
    assert velocities == {(2.0, 0.0), (1.2, 1.0), (1.2, -1.0), (0.0, 0.0)}


def test_export_uses_given_velocities_when_odometry_is_missing(tmp_path: Path) -> None:
    file = recording(tmp_path / "recordings", odometry=False)
    with pytest.raises(
        JobError, match="episode drive: no odometry for the speed of forward; give it with --speed"
    ):
        exported([file], "rosbag2", tmp_path / "none")
    with pytest.raises(
        JobError, match="no odometry for the speed of left; give it with --turn-rate"
    ):
        exported([file], "rosbag2", tmp_path / "none", speed=0.5)
    nominal, _ = exported([file], "rosbag2", tmp_path / "out", speed=0.5, turn_rate=1.0)
    assert (nominal.speed.origin, nominal.turn_rate.origin) == (
        "given by --speed",
        "given by --turn-rate",
    )
    (back,) = brought_back(tmp_path / "out/drive", "rosbag2", tmp_path / "back")
    assert list(atoms_of(back).values()) == list(MADE)
    assert back.odometry[8].x_m == pytest.approx(0.4)


def test_export_joins_drives_when_some_lack_odometry(
    tmp_path: Path,
) -> None:
    files = [
        recording(tmp_path / "recordings", name, odometry=name == "with")
        for name in ("with", "without")
    ]
    exported(files, "folder", tmp_path / "folder")
    back = brought_back(tmp_path / "folder", "folder", tmp_path / "back", reckon=False)
    assert [bool(episode.odometry) for episode in back] == [True, False]
    _, tally = exported(files, "lerobot", tmp_path / "set")
    assert (
        f"{FRAMES} of {2 * FRAMES} frames lack odometry; observation.state is left out"
        in tally.lines()
    )


def test_bag_has_the_topics_of_a_robot(tmp_path: Path) -> None:
    """The reader of rosbags checks topics, types and stamps."""
    from rosbags.highlevel import AnyReader  # noqa: PLC0415

    file = recording(tmp_path / "recordings")
    exported([file], "rosbag2", tmp_path / "out")
    with AnyReader([tmp_path / "out/drive"]) as bag:
        said = [
            (
                connection.topic,
                connection.msgtype.rpartition("/")[2],
                at_ns,
                bag.deserialize(data, connection.msgtype),
            )
            for connection, at_ns, data in bag.messages()
        ]
    assert Counter((topic, kind) for topic, kind, _, _ in said) == {
        ("/camera/image_raw/compressed", "CompressedImage"): FRAMES, ("/camera/camera_info", "CameraInfo"): FRAMES,
        ("/odom", "Odometry"): FRAMES, ("/tf", "TFMessage"): FRAMES, ("/tf_static", "TFMessage"): 1,
        ("/cmd_vel", "TwistStamped"): FRAMES, ("/imu", "Imu"): 2 * (FRAMES - 1),
    }  # fmt: skip
    for topic, _, stamp_ns, message in said:
        for one in message.transforms if topic.startswith("/tf") else [message]:
            assert one.header.stamp.sec * 10**9 + one.header.stamp.nanosec == stamp_ns
    by_topic = {
        topic: [message for name, _, _, message in said if name == topic] for topic, *_ in said
    }
    for odometry, moved, pose in zip(by_topic["/odom"], by_topic["/tf"], poses(), strict=True):
        check_odometry(odometry, moved.transforms[0], pose)
    info = by_topic["/camera/camera_info"][0]
    imu = by_topic["/imu"][0]
    camera = (info.k[0], info.k[4], info.k[2], info.k[5], info.width, info.height)
    assert camera == (44.8, 44.8, 32.0, 24.0, 64, 48)
    inertia = imu.linear_acceleration.z, imu.angular_velocity.z, imu.orientation_covariance[0]
    assert inertia == (9.81, 0.06, -1.0)
    # The camera looks ahead: its z is the robot's x, its x the robot's -y.
    turn = by_topic["/tf_static"][0].transforms[0].transform.rotation
    assert (turn.x, turn.y, turn.z, turn.w) == (-0.5, 0.5, -0.5, 0.5)


def check_odometry(odometry: Any, transform: Any, pose: corridor.Pose) -> None:
    x, y, heading = pose
    for one in (transform, odometry):
        assert (one.header.frame_id, one.child_frame_id) == ("odom", "base_link")
    for place, turn in (
        (odometry.pose.pose.position, odometry.pose.pose.orientation),
        (transform.transform.translation, transform.transform.rotation),
    ):
        assert (place.x, place.y, place.z) == (x, y, 0.0)
        assert (turn.z, turn.w) == (math.sin(heading / 2), math.cos(heading / 2))
    assert (odometry.twist.twist.linear.x, odometry.twist.twist.angular.z) == (1.5, 0.25)


def test_export_rejects_times_that_exceed_ros(tmp_path: Path) -> None:
    file = recording(tmp_path / "recordings", start_ns=5 * 10**18)
    with pytest.raises(JobError, match="time 5000000000 s after 1970 is too large for ROS"):
        exported([file], "rosbag2", tmp_path / "out")


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Make a data set of two drives."""
    folder = tmp_path_factory.mktemp("lerobot")
    exported(
        [recording(folder / "recordings", name) for name in ("one", "two")],
        "lerobot",
        folder / "set",
    )
    return folder / "set"


def table_of(path: Path) -> Any:
    import pyarrow.parquet as pq  # noqa: PLC0415

    return pq.read_table(path)


def test_dataset_has_files_and_columns_of_lerobot(dataset: Path) -> None:
    """LeRobot 0.4 rejects rows whose columns differ from the description."""
    info = json.loads((dataset / "meta/info.json").read_text())
    assert (info["codebase_version"], info["fps"], info["total_episodes"]) == ("v3.0", 10, 2)
    assert (info["total_frames"], info["total_tasks"], info["splits"]) == (
        2 * FRAMES,
        1,
        {"train": "0:2"},
    )
    assert info["features"][CAMERA]["shape"] == [48, 64, 3]
    table = table_of(dataset / info["data_path"].format(chunk_index=0, file_index=0))
    assert set(table.column_names) == set(info["features"]) - {CAMERA}
    for name in table.column_names:
        kind = info["features"][name]["dtype"]
        shape = info["features"][name]["shape"]
        arrow = {"float32": "float", "int64": "int64", "bool": "bool"}[kind]
        wanted = arrow if shape == [1] else f"fixed_size_list<element: {arrow}>[{shape[0]}]"
        assert str(table.schema.field(name).type).replace("item:", "element:") == wanted
    rows = table.to_pydict()
    assert rows["index"] == list(range(2 * FRAMES))
    assert rows["frame_index"] == [*range(FRAMES)] * 2
    assert rows["episode_index"] == [0] * FRAMES + [1] * FRAMES
    np.testing.assert_allclose(rows["timestamp"], np.array(rows["frame_index"]) / 10, atol=1e-6)
    assert [at for at, arrived in enumerate(rows["next.success"]) if arrived] == [
        FRAMES - 1,
        2 * FRAMES - 1,
    ]
    np.testing.assert_allclose(rows["observation.state"][:FRAMES], poses(), atol=1e-5)
    episodes = table_of(dataset / "meta/episodes/chunk-000/file-000.parquet").to_pydict()
    assert episodes["length"] == [FRAMES, FRAMES]
    assert (episodes["dataset_from_index"], episodes["dataset_to_index"]) == (
        [0, FRAMES],
        [FRAMES, 2 * FRAMES],
    )
    tasks = table_of(dataset / "meta/tasks.parquet")
    assert tasks.to_pydict() == {"task_index": [0], "task": ["Go to the dock."]}
    assert json.loads(tasks.schema.metadata[b"pandas"])["index_columns"] == ["task"]


def test_dataset_videos_show_each_frame_at_its_time(dataset: Path) -> None:
    """The tolerance of lerobot is 1e-4 s."""
    av = pytest.importorskip("av")
    views = np.stack([corridor.view(*pose) for pose in poses()]).astype(float)
    episodes = table_of(dataset / "meta/episodes/chunk-000/file-000.parquet").to_pydict()
    info = json.loads((dataset / "meta/info.json").read_text())
    for number in range(2):
        told = {
            name: episodes[f"videos/{CAMERA}/{name}"][number]
            for name in ("chunk_index", "file_index")
        }
        with av.open(str(dataset / info["video_path"].format(video_key=CAMERA, **told))) as video:
            assert video.streams.video[0].pix_fmt == "yuv420p"
            frames = [
                (float(frame.time), frame.to_ndarray(format="rgb24"))
                for frame in video.decode(video=0)
            ]
        assert len(frames) == FRAMES
        for frame, (time_s, pixels) in enumerate(frames):
            assert time_s + episodes[f"videos/{CAMERA}/from_timestamp"][number] == pytest.approx(
                frame / 10, abs=1e-4
            )
            off = np.abs(views - pixels).mean(axis=(1, 2, 3))
            assert off[frame] < min(off.min() + 0.5, 10.0)


def test_dataset_statistics_match_its_values(dataset: Path) -> None:
    stats = json.loads((dataset / "meta/stats.json").read_text())
    rows = table_of(dataset / "data/chunk-000/file-000.parquet").to_pydict()
    assert set(stats) == set(json.loads((dataset / "meta/info.json").read_text())["features"])
    pixels = np.stack([decode_jpeg(encode_jpeg(corridor.view(*pose))) for pose in poses()]) / 255.0
    values = {
        key: np.array(rows[key], float).reshape(len(rows[key]), -1)
        for key in ("action", "next.success")
    }
    for key, seen in (values | {CAMERA: pixels.reshape(-1, 3)}).items():
        for name in ("min", "max", "mean", "std"):
            np.testing.assert_allclose(
                np.ravel(stats[key][name]), getattr(seen, name)(axis=0), atol=1e-9
            )
        np.testing.assert_allclose(
            np.ravel(stats[key]["q50"]), np.median(seen, axis=0), atol=1 / 255
        )
    assert np.shape(stats[CAMERA]["mean"]) == (3, 1, 1)
    episodes = table_of(dataset / "meta/episodes/chunk-000/file-000.parquet").to_pydict()
    assert episodes["stats/action/max"][0] == stats["action"]["max"]


def test_export_reports_images_when_sizes_are_unsupported(tmp_path: Path) -> None:
    odd = {tick: encode_jpeg(np.zeros((49, 65, 3), np.uint8)) for tick in range(FRAMES)}
    with pytest.raises(
        JobError,
        match="unsupported image size 65x49: a video needs even numbers of columns and rows",
    ):
        exported([recording(tmp_path / "odd", jpeg=odd)], "lerobot", tmp_path / "none")
    files = [recording(tmp_path / "recordings", f"scale-{scale}", scale=scale) for scale in (1, 2)]
    _, tally = exported(files, "lerobot", tmp_path / "set")
    assert f"{FRAMES} images differ in size from the first (left out)" in tally.lines()


@pytest.mark.parametrize("form", FORMATS)
def test_export_counts_damaged_images_and_open_frames(form: str, tmp_path: Path) -> None:
    """A killed recorder leaves a last frame without a movement."""
    file = recording(
        tmp_path / "recordings", jpeg={3: b"GIF89a", 4: b"\xff\xd8\xff\xd9"}, outcome=None
    )
    _, tally = exported([file], form, tmp_path / "out")
    assert tally.counts["images are damaged"] == 2
    if form != "rosbag2":
        assert "1 frames lack an action (left out)" in tally.lines()
        assert {
            episode.outcome for episode in brought_back(tmp_path / "out", form, tmp_path / "back")
        } == {"aborted"}


def test_export_reports_unreadable_files_and_keeps_the_rest(tmp_path: Path) -> None:
    whole = recording(tmp_path / "recordings")
    copy = tmp_path / "copy.mcap"
    noise = tmp_path / "noise.mcap"
    copy.write_bytes(whole.read_bytes())
    noise.write_bytes(np.random.default_rng(1).bytes(1000))
    _, tally = exported([noise, whole, copy], "folder", tmp_path / "out")
    assert f"{noise}: not an MCAP file" in tally.lines()
    assert f"{copy}: episode drive left out: already in {whole}" in tally.lines()
    assert len(list((tmp_path / "out/drive").iterdir())) == FRAMES

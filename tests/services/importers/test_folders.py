"""Folders of images or of a video give the drive that was put in, for tables of any software."""

import csv
import io
import math
import struct
from collections.abc import Callable
from pathlib import Path
from unicodedata import normalize

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from services.importers.drive import ImportFailure, Tally
from services.importers.ticks import motion_along
from services.importers.trajectory import track_of
from services.recordings.dataset import Teacher
from smal.movement import wrapped
from tests import corridor
from tests.services.importers import bags, sources
from tests.services.importers.test_formats import check_drive, episode_of, imported

#: A camera looks along z, with x to the right and y down: its axes in those of the robot.
OPTICAL = Rotation.from_matrix([[0, 0, 1], [-1, 0, 0], [0, -1, 0]])
#: Somebody stuck the markers of the tracking system on the robot as they came.
ANYHOW = Rotation.from_euler("zyx", [37.0, 10.0, 160.0], degrees=True)


def write_images(folder: Path, moments: list[sources.Moment], names: list[str]) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for moment, name in zip(moments, names, strict=True):
        (folder / name).write_bytes(cv2.imencode(".png", moment.image[..., ::-1])[1].tobytes())


def placed(moment: sources.Moment, mount: Rotation) -> tuple[np.ndarray, Rotation]:
    """Return where the body is in space, and how it is turned."""
    x, y, heading = moment.pose
    return np.array([x, y, 0.3]), Rotation.from_euler("z", heading) * mount


def tum(folder: Path, mount: Rotation) -> Path:
    moments = sources.drive(20.0)
    names = [f"{moment.time_s:.6f}.png" for moment in moments]
    write_images(folder / "rgb", moments, names)
    lines = [f"{moment.time_s:.6f} rgb/{name}" for moment, name in zip(moments, names, strict=True)]
    (folder / "rgb.txt").write_text("\n".join(["# color images", "# timestamp filename", *lines]))
    (folder / "accelerometer.txt").write_text("# timestamp ax ay az\n1 0 0 9.8\n")
    poses = []
    for moment in sources.drive(100.0):
        place, turn = placed(moment, mount)
        poses.append(" ".join(map(str, [moment.time_s, *place, *turn.as_quat(), "# a comment"])))
    (folder / "groundtruth.txt").write_text("\n".join(["# ground truth trajectory", *poses]))
    return folder


def kitti(folder: Path, poses: str) -> Path:
    """Write a sequence: poses of the first camera from its first pose, y down and z ahead."""
    moments = sources.drive(20.0)
    write_images(folder / "image_2", moments, [f"{row:06d}.png" for row in range(len(moments))])
    first = moments[0].time_s
    (folder / "times.txt").write_text("\n".join(f"{one.time_s - first:e}" for one in moments))
    lines = []
    for moment in moments:
        place, turn = placed(moment, OPTICAL)
        matrix = np.column_stack([(OPTICAL.inv() * turn).as_matrix(), OPTICAL.inv().apply(place)])
        lines.append(" ".join(map(str, matrix.ravel())))
    (folder / poses).resolve().parent.mkdir(exist_ok=True)
    (folder / poses).write_text("\n".join(lines))
    return folder


def rgb_folder(folder: Path) -> Path:
    """Write images whose names are their times, and poses of any name."""
    tum(folder, ANYHOW)
    (folder / "rgb.txt").unlink()
    (folder / "groundtruth.txt").rename(folder / "trajectory.TXT")
    (folder / "readme.txt").write_text("these are the eight words of a readme")
    return folder


def bare_euroc(folder: Path) -> Path:
    """Write the sensors without the folder above them, poses of another name, and inertia."""
    for sensor in (euroc(folder) / "mav0").iterdir():
        named = "mocap0" if "truth" in sensor.name else sensor.name
        sensor.rename(folder / named)
    (folder / "mav0").rmdir()
    (folder / "imu0").mkdir()
    (folder / "imu0/data.csv").write_text("#timestamp [ns],w,w,w,a,a,a\n1,0,0,0,0,0,9.8\n")
    return folder


def kitti_sequences(folder: Path) -> Path:
    for number in ("00", "11"):
        kitti(folder / "sequences" / number, f"../../poses_{number}.txt")
    (folder / "poses").mkdir()
    (folder / "poses_00.txt").rename(folder / "poses/00.txt")
    (folder / "poses_11.txt").unlink()
    return folder


def kitti_raw(folder: Path) -> Path:
    """Write raw data: positions by satellite, each in a file, and dates."""
    moments = sources.drive(20.0)
    names = [f"{row:010d}" for row in range(len(moments))]
    write_images(folder / "image_02/data", moments, [f"{name}.png" for name in names])
    (folder / "oxts/data").mkdir(parents=True)
    dates = [str(np.datetime64(round(one.time_s * 1e9), "ns")).replace("T", " ") for one in moments]
    for sensor in ("image_02", "oxts"):
        (folder / sensor / "timestamps.txt").write_text("\n".join(dates))
    for moment, name in zip(moments, names, strict=True):
        x, y, heading = moment.pose
        north = 49.0 + np.degrees(y / 6_378_137.0)
        east = 8.4 + np.degrees(x / 6_378_137.0 / np.cos(np.radians(49.0)))
        row = [f"{north:.12f}", f"{east:.12f}", 116.4, 0.02, -0.01, heading, *[0.0] * 24]
        (folder / f"oxts/data/{name}.txt").write_text(" ".join(map(str, row)))
    return folder


def euroc(folder: Path) -> Path:
    moments = sources.drive(20.0)
    stamps = [round(moment.time_s * 1e9) for moment in moments]
    camera = folder / "mav0/cam0"
    write_images(camera / "data", moments, [f"{stamp}.png" for stamp in stamps])
    lines = [f"{stamp},{stamp}.png" for stamp in stamps]
    (camera / "data.csv").write_text("\r\n".join(["#timestamp [ns],filename", *lines]))
    truth = folder / "mav0/state_groundtruth_estimate0"
    truth.mkdir()
    rows = ["#timestamp, p_RS_R_x [m], y, z, q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z [], v_RS_R_x"]
    for moment in moments:
        place, turn = placed(moment, ANYHOW)
        x, y, z, w = turn.as_quat()
        numbers = [round(moment.time_s * 1e9), *place, w, x, y, z, 0.0]
        rows.append(",".join(map(str, numbers)))
    (truth / "data.csv").write_text("\n".join(rows))
    return folder


LAYOUTS: dict[str, Callable[[Path], Path]] = {
    "tum": lambda path: tum(path, OPTICAL),
    "tum-markers": lambda path: tum(path, ANYHOW),
    "tum-names": rgb_folder,
    "euroc-bare": bare_euroc,
    "kitti": lambda path: kitti(path, "00.txt"),
    "kitti-sequences": kitti_sequences,
    "kitti-raw": kitti_raw,
    "euroc": euroc,
}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_layout_of_a_data_set_is_imported(layout: str, tmp_path: Path) -> None:
    report, tally = imported(LAYOUTS[layout](tmp_path / "set"), "folder", tmp_path / "out")
    assert report.odometry == "of the source"
    assert "velocities are computed from poses" in tally.lines()
    check_drive(episode_of(report), blurred=4)
    assert report.speed == pytest.approx(2.0, rel=0.02)
    assert report.turn_rate == pytest.approx(0.8, rel=0.02)


def left_handed(poses: Path) -> None:
    """Mirror the poses of a file: the axis to the left becomes the axis to the right."""
    signs = np.array([1.0, 1.0, -1.0, 1.0, -1.0, 1.0, -1.0, 1.0])
    np.savetxt(poses, np.loadtxt(poses) * signs, "%.9f")


@pytest.mark.parametrize("cause", ["lens", "poses"])
def test_remedy_needs_no_velocities_when_views_turn_otherwise(cause: str, tmp_path: Path) -> None:
    folder = tum(tmp_path / "set", OPTICAL)
    if cause == "poses":
        left_handed(folder / "groundtruth.txt")
    for file in folder.glob("rgb/*.png") if cause == "lens" else ():
        cv2.imwrite(str(file), np.rot90(cv2.imread(str(file)), 2))
    _, tally = imported(folder, "folder", tmp_path / "out")
    (remark,) = [line for line in tally.lines() if "the views turn to the other side" in line]
    assert "give --rotate 180; if the axes of the poses are left-handed, convert" in remark
    assert "--turn-rate" not in remark
    if cause == "poses":
        left_handed(folder / "groundtruth.txt")
    upright = {"rotate_deg": 180} if cause == "lens" else {}
    report, tally = imported(folder, "folder", tmp_path / "mended", **upright)
    assert "the views turn to the other side" not in " ".join(tally.lines())
    check_drive(episode_of(report), blurred=4)


def test_layout_is_refused_when_it_has_no_poses(tmp_path: Path) -> None:
    folder = tum(tmp_path / "set", OPTICAL)
    (folder / "groundtruth.txt").unlink()
    with pytest.raises(
        ImportFailure, match=r"0 files of poses with 8 numbers a line among accelerometer\.txt, rgb"
    ):
        imported(folder, "folder", tmp_path / "out")


def test_layout_is_refused_when_its_clocks_differ(tmp_path: Path) -> None:
    folder = tum(tmp_path / "set", OPTICAL)
    poses = (folder / "groundtruth.txt").read_text()
    (folder / "groundtruth.txt").write_text(poses.replace("\n17000000", "\n18000000"))
    with pytest.raises(ImportFailure, match=r"no image at the times of the poses \(1800000000.0"):
        imported(folder, "folder", tmp_path / "out")


def test_heading_is_the_movement_when_a_pose_never_turns() -> None:
    angle = np.linspace(0.0, np.pi, 200)
    still = np.tile([0.0, 0.0, 0.0, 1.0], (200, 1))
    places = np.column_stack([np.sin(angle), 1.0 - np.cos(angle), 0.0 * angle])
    tally = Tally()
    track = track_of(np.column_stack([angle, places, still]), tally)
    assert np.abs(track[:, 3] - angle).max() < 0.1
    motion = motion_along(track)
    assert motion[:, 1] == pytest.approx(1.0, abs=0.1)
    assert "orientations do not turn with the robot" in tally.lines()[0]


def test_heading_is_kept_when_a_third_is_reversed() -> None:
    angle = np.concatenate([np.linspace(0.0, 1.0, 200), np.linspace(1.0, 0.5, 100)])
    turns = Rotation.from_euler("z", angle[:, None] + 2.0).as_quat()
    places = np.column_stack([4.0 * np.sin(angle), 4.0 - 4.0 * np.cos(angle), 0.0 * angle])
    tally = Tally()
    track = track_of(np.column_stack([np.arange(300) / 20.0, places, turns]), tally)
    assert np.abs(wrapped(track[:, 3] - angle)).max() < 0.1
    assert not tally.lines()


def written_table(
    folder: Path, delimiter: str, *, comma: bool, coding: str, lead: str = ""
) -> None:
    """Write the table of a folder anew, as a program for spreadsheets does."""
    rows = list(csv.reader((folder / "drive.csv").read_text().splitlines()))
    for row in rows[1:]:
        row[:] = [cell.replace(".", ",") if comma and ".png" not in cell else cell for cell in row]
    text = io.StringIO(newline="")
    csv.writer(text, delimiter=delimiter, lineterminator="\r\n").writerows(rows)
    (folder / "drive.csv").write_bytes((lead + text.getvalue()).encode(coding))


TABLES = {
    "excel": {"delimiter": ";", "comma": True, "coding": "utf-8-sig"},
    "excel-sep": {"delimiter": ";", "comma": True, "coding": "utf-8", "lead": "sep=;\r\n"},
    "windows": {"delimiter": ",", "comma": False, "coding": "cp1252"},
    "quoted": {"delimiter": ",", "comma": True, "coding": "utf-8"},
    "tabs": {"delimiter": "\t", "comma": False, "coding": "utf-8-sig"},
}


@pytest.mark.parametrize("kind", TABLES)
def test_table_of_a_spreadsheet_is_imported(kind: str, tmp_path: Path) -> None:
    folder = sources.csv_folder(tmp_path / "set", png=True)
    for file in folder.glob("*.png"):
        file.rename(folder / normalize("NFD", f"Bild ä{file.stem}.PNG"))
    text = (folder / "drive.csv").read_text()
    named = "".join(
        line.replace(f",{row:04d}.png", f",Bild ä{row:04d}.png")
        for row, line in enumerate(text.splitlines(keepends=True), -1)
    )
    (folder / "drive.csv").write_text(named)
    written_table(folder, **TABLES[kind])
    report, tally = imported(folder, "folder", tmp_path / "out")
    check_drive(episode_of(report), blurred=2)
    assert "images cannot be read" not in tally.counts


def test_images_of_16_bits_and_four_channels_are_read(tmp_path: Path) -> None:
    folder = sources.csv_folder(tmp_path / "set", 10.0, png=True)
    for number, file in enumerate(sorted(folder.glob("*.png"))):
        image = cv2.imread(str(file))
        deep = image.astype(np.uint16) * 257
        clear = np.dstack([image, np.full(image.shape[:2], 9, np.uint8)])
        cv2.imwrite(str(file), (deep, clear)[number % 2])
    check_drive(episode_of(imported(folder, "folder", tmp_path / "out")[0]))


def test_poses_give_velocities_when_a_table_has_none(tmp_path: Path) -> None:
    folder = sources.csv_folder(tmp_path / "set")
    text = (folder / "drive.csv").read_text()
    (folder / "drive.csv").write_text(text.replace("linear_m_s,angular_rad_s", "a,b"))
    check_drive(episode_of(imported(folder, "folder", tmp_path / "out")[0]), blurred=3)


def changed_column(folder: Path, name: str, change: Callable[[float], object]) -> None:
    """Change the numbers in a column of a table."""
    table = folder / "drive.csv"
    with table.open(newline="") as file:
        rows = list(csv.DictReader(file))
    with table.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(row | {name: change(float(row[name]))} for row in rows)


@pytest.mark.parametrize(
    ("factor", "unit"), [(1e3, "milliseconds"), (1e6, "microseconds"), (1e9, "nanoseconds")]
)
@pytest.mark.parametrize("filmed", [True, False])
def test_times_are_converted_when_they_are_not_seconds(
    factor: float, unit: str, filmed: bool, tmp_path: Path
) -> None:
    folder = film(tmp_path / "set") if filmed else sources.csv_folder(tmp_path / "set")
    changed_column(folder, "time_s", lambda time_s: round(time_s * factor))
    report, tally = imported(folder, "folder", tmp_path / "out")
    check_drive(episode_of(report), blurred=3)
    assert any(f"times are in {unit}" in line for line in tally.lines())


@pytest.mark.parametrize("velocities", [True, False])
def test_headings_are_converted_when_they_are_degrees(velocities: bool, tmp_path: Path) -> None:
    """The velocities, or else the direction of the motion, show the unit."""
    rows = ["image,time_s,linear_m_s,angular_rad_s,x_m,y_m,heading_rad"]
    for number, frame in enumerate(bags.drive()):
        (tmp_path / f"{number}.jpg").write_bytes(frame.jpeg)
        x, y, heading = frame.pose
        cells = [frame.time_s, frame.linear, frame.angular, x, y, math.degrees(heading)]
        rows.append(",".join([f"{number}.jpg", *map(str, cells)]))
    if not velocities:
        rows[0] = rows[0].replace("linear_m_s,angular_rad_s", "a,b")
    (tmp_path / "drive.csv").write_text("\n".join(rows))
    report, tally = imported(tmp_path, "folder", tmp_path / "out")
    headings = [one.heading_rad for one in episode_of(report).odometry.values()]
    assert headings == pytest.approx([frame.pose[2] for frame in bags.drive()], abs=0.05)
    assert any("headings are in degrees; converted" in line for line in tally.lines())


def test_rows_are_read_once_when_they_are_repeated(tmp_path: Path) -> None:
    folder = sources.csv_folder(tmp_path / "set")
    head, *rows = (folder / "drive.csv").read_text().splitlines()
    (folder / "drive.csv").write_text("\n".join([head, *rows * 10]))
    report, tally = imported(folder, "folder", tmp_path / "out")
    check_drive(episode_of(report), blurred=2)
    assert tally.counts["rows are repeated (read once)"] == 9 * len(rows)
    assert not [line for line in tally.lines() if "set back" in line]


def test_row_is_named_when_commas_split_its_numbers(tmp_path: Path) -> None:
    folder = sources.csv_folder(tmp_path / "set")
    head, *rows = (folder / "drive.csv").read_text().splitlines()
    text = "\n".join([head, *(row.replace(".", ",").replace(",jpg", ".jpg") for row in rows)])
    (folder / "drive.csv").write_text(text)
    with pytest.raises(ImportFailure, match="row 1: more cells than columns; if numbers have com"):
        imported(folder, "folder", tmp_path / "out")


def test_row_is_named_when_its_time_is_a_date(tmp_path: Path) -> None:
    folder = sources.csv_folder(tmp_path / "set")
    changed_column(folder, "time_s", lambda _: "2026-01-01T00:00:00")
    with pytest.raises(ImportFailure, match="row 1: time_s: '2026-01-01T00:00:00' must be a val"):
        imported(folder, "folder", tmp_path / "out")


def test_missing_images_are_reported_in_two_lines(tmp_path: Path) -> None:
    folder = sources.csv_folder(tmp_path / "set")
    for file in sorted(folder.glob("*.jpg"))[20:30]:
        file.unlink()
    _, tally = imported(folder, "folder", tmp_path / "out")
    assert len([line for line in tally.lines() if "No such file" in line]) == 1


def test_drive_is_left_out_when_its_images_change_their_shape(tmp_path: Path) -> None:
    folder = sources.csv_folder(tmp_path / "set")
    for file in sorted(folder.glob("*.jpg"))[30:]:
        cv2.imwrite(str(file), cv2.imread(str(file))[8:])
    report, _ = imported(folder, "folder", tmp_path / "out")
    teaching = Teacher(corridor.FEATURES, shortest=1).read_all(
        [Path(file) for file in report.files], lambda *_: None
    )
    assert not teaching.demonstrations
    (line,) = [line for line in teaching.lines() if "images of 64x40 differ from 64x48" in line]
    assert "another aspect ratio shows another view" in line


@pytest.mark.parametrize("brand", [b"heic", b"avif"])
def test_format_is_named_when_images_do_not_decode(brand: bytes, tmp_path: Path) -> None:
    folder = sources.csv_folder(tmp_path / "set")
    for file in folder.glob("*.jpg"):
        file.write_bytes(b"\0\0\0\x18ftyp" + brand + bytes(100))
    with pytest.raises(ImportFailure, match=rf"images .{brand.decode().upper()}. .*convert them"):
        imported(folder, "folder", tmp_path / "out")


def test_refusal_names_the_archive_to_unpack(tmp_path: Path) -> None:
    folder = tmp_path / "packed"
    folder.mkdir()
    (folder / "tub.zip").write_bytes(b"PK\3\4")
    for path, form in ((folder, "donkeycar"), (folder / "tub.zip", "rosbag2")):
        with pytest.raises(ImportFailure, match=rf"nothing of the format {form}; unpack tub.zip"):
            imported(path, form, tmp_path / "out")


SENSOR = """%YAML:1.0
# General sensor definitions.
sensor_type: camera
resolution: [64, 48]
camera_model: pinhole
intrinsics: [45.0, 45.0, 33.0, 23.0] #fu, fv, cu, cv
distortion_model: radial-tangential
distortion_coefficients: [-0.28, 0.07, 0.0002, 0.00002]
"""


@pytest.mark.parametrize("layout", ["euroc", "kitti"])
def test_calibration_beside_images_is_imported(layout: str, tmp_path: Path) -> None:
    if layout == "euroc":
        folder = euroc(tmp_path / "set")
        (folder / "mav0/cam0/sensor.yaml").write_text(SENSOR)
    else:
        folder = kitti(tmp_path / "set", "poses.txt")
        row = "45 0 33 0 0 45 23 0 0 0 1 0"
        lines = [f"P{number}: {row.replace('45', str(43 + number))}\n" for number in range(4)]
        (folder / "calib.txt").write_text("".join(lines))
    report, _ = imported(folder, "folder", tmp_path / "out")
    info = episode_of(report).camera
    assert info is not None
    assert (info.focal_px, info.centre_x_px, info.centre_y_px) == pytest.approx((45.0, 33.0, 23.0))
    assert report.field_of_view_deg == pytest.approx(81.0 if layout == "euroc" else 70.8, abs=1.0)


def test_calibration_is_reported_when_it_is_unsupported(tmp_path: Path) -> None:
    folder = euroc(tmp_path / "set")
    camera = folder / "mav0/cam0/sensor.yaml"
    for wrong in (SENSOR.replace("radial-tangential", "fov"), "resolution: [64, 48]", "]"):
        camera.write_text(wrong)
        report, tally = imported(folder, "folder", tmp_path / "out")
        assert report.field_of_view_deg is None
        assert any("sensor.yaml: calibration not used: " in line for line in tally.lines())


def test_rows_are_counted_when_the_video_ends_before(tmp_path: Path) -> None:
    folder = film(tmp_path / "set", "drive.mkv")
    images = [moment.image for moment in sources.drive(20.0)]
    changed_column(folder, "time_s", lambda time_s: time_s - sources.START_S)
    sources.mp4(folder / "drive.mkv", images[:40], 20)
    _, tally = imported(folder, "folder", tmp_path / "out")
    assert tally.counts["rows are later than the end of the video (left out)"] > 10


def film(folder: Path, name: str = "drive.mp4") -> Path:
    """Write a video of the drive, and its table without images."""
    sources.csv_folder(folder)
    for file in folder.glob("*.jpg"):
        file.unlink()
    sources.mp4(folder / name, [moment.image for moment in sources.drive(20.0)], 20)
    text = (folder / "drive.csv").read_text()
    (folder / "drive.csv").write_text(text.replace("time_s,image", "time_s,note"))
    return folder


@pytest.mark.parametrize("name", ["drive.mp4", "drive.mkv"])
def test_video_with_a_table_is_imported(name: str, tmp_path: Path) -> None:
    report, _ = imported(film(tmp_path / "set", name), "folder", tmp_path / "out")
    check_drive(episode_of(report), blurred=3)


def test_video_begins_at_the_first_row_of_its_table(tmp_path: Path) -> None:
    folder = film(tmp_path / "set")
    lines = (folder / "drive.csv").read_text().splitlines()
    (folder / "drive.csv").write_text("\n".join([lines[0], *lines[1::2]]))
    report, tally = imported(folder, "folder", tmp_path / "out")
    assert "the video drive.mp4 begins at the first row" in tally.lines()
    check_drive(episode_of(report), blurred=3)


def test_video_of_a_phone_stands_upright(tmp_path: Path) -> None:
    folder = film(tmp_path / "set")
    lying = [np.rot90(moment.image) for moment in sources.drive(20.0)]
    sources.mp4(folder / "drive.mp4", [np.ascontiguousarray(one) for one in lying], 20)
    data = (folder / "drive.mp4").read_bytes()
    straight = struct.pack(">9i", 2**16, 0, 0, 0, 2**16, 0, 0, 0, 2**30)
    clockwise = struct.pack(">9i", 0, 2**16, 0, -(2**16), 0, 0, 0, 0, 2**30)
    at = data.index(straight, data.index(b"tkhd"))
    (folder / "drive.mp4").write_bytes(data[:at] + clockwise + data[at + len(straight) :])
    video = cv2.VideoCapture(str(folder / "drive.mp4"), cv2.CAP_FFMPEG)
    assert video.read()[1].shape == (48, 64, 3)
    check_drive(episode_of(imported(folder, "folder", tmp_path / "out")[0]), blurred=3)


def test_table_without_images_wants_one_video(tmp_path: Path) -> None:
    folder = film(tmp_path / "set")
    (folder / "drive.mp4").unlink()
    with pytest.raises(ImportFailure, match=r"lacks the columns image; it has time_s, note, lin"):
        imported(folder, "folder", tmp_path / "out")


def film_of_two(folder: Path, frames: int) -> Path:
    """Write a video of two drives whose times both begin at 0."""
    film(folder)
    head, *lines = (folder / "drive.csv").read_text().splitlines()
    counted = [
        ",".join([f"{0.05 * at:.2f}", *line.split(",")[1:]]) for at, line in enumerate(lines)
    ]
    rows = [f"{line},{episode}" for episode in "ab" for line in counted]
    (folder / "drive.csv").write_text("\n".join([f"{head},episode", *rows]))
    images = [moment.image for moment in sources.drive(20.0)]
    sources.mp4(folder / "drive.mp4", (images * 2)[:frames], 20)
    return folder


def test_video_of_two_drives_gives_each_its_frames(tmp_path: Path) -> None:
    folder = film_of_two(tmp_path / "set", 2 * len(sources.drive(20.0)))
    report, _ = imported(folder, "folder", tmp_path / "out")
    first, second = (episode_of(file) for file in report.files)
    check_drive(first, blurred=3)
    check_drive(second, blurred=3)
    assert bytes(first.images[0]) != bytes(second.images[0])


def test_video_is_refused_when_episodes_overlap(tmp_path: Path) -> None:
    folder = film_of_two(tmp_path / "set", 100)
    with pytest.raises(ImportFailure, match="episodes overlap in time"):
        imported(folder, "folder", tmp_path / "out")

"""Every format gives the drive that was put in: its views, its movements, where it went."""

import json
from collections.abc import Callable
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest

from services.importers import images
from services.importers.drive import ImportFailure, Tally
from services.importers.job import ImportJob, ImportReport
from services.importers.run import run
from services.kit.cameras import camera_of
from services.recordings.dataset import Teacher
from services.recordings.encoding import decode_image
from services.recordings.reader import read_recording
from services.recordings.recorded import RecordedEpisode
from smal.features import extract
from smal.movement import Atom
from smal.robot import Localizer
from smal.teaching.mapping import learn
from tests import corridor
from tests.services.importers import sources

pytest.importorskip("rosbags", reason="needs the extra formats")
pq = pytest.importorskip("pyarrow.parquet", reason="needs the extra formats")

MADE = (
    ["forward"] * 15 + ["left"] * 4 + ["right"] * 4 + ["forward"] * 10 + ["stop"]
)  # The drive in ticks.
FRAMES = len(sources.drive(20.0))


def imported(path: Path, form: str, folder: Path, **fields: object) -> tuple[ImportReport, Tally]:
    folder.mkdir(exist_ok=True)
    tally = Tally()
    job = ImportJob.model_validate(
        {"format": form, "path": str(path), "folder": str(folder), "robot": "burger"} | fields
    )
    return run(job, tally), tally


def episode_of(source: ImportReport | Path | str) -> RecordedEpisode:
    (episode,) = read_recording(
        Path(source.files[0] if isinstance(source, ImportReport) else source)
    ).episodes
    return episode


def atoms_of(episode: RecordedEpisode) -> list[str]:
    return [episode.applied[tick].atom for tick in sorted(episode.applied)]


def check_drive(episode: RecordedEpisode, *, blurred: int = 0, within_m: float = 0.03) -> None:
    """Check views, movements and the way; at the change of two legs a tick may be a little of each."""
    views = np.stack([moment.image for moment in sources.drive(10.0)]).astype(float)
    assert len(episode.images) == len(MADE)
    for tick, payload in episode.images.items():
        off = np.abs(views - decode_image(bytes(payload))).mean(axis=(1, 2, 3))
        # In turning back the robot sees some views again.
        assert off[tick] < min(off.min() + 0.5, 10.0)
    assert sum(one != other for one, other in zip(atoms_of(episode), MADE, strict=True)) <= blurred
    for tick in episode.odometry:
        x_m, y_m, heading_rad = episode.odometry[tick].pose
        x, y, heading = sources.drive(10.0)[tick].pose
        assert np.hypot(x_m - x, y_m - y) < within_m
        assert abs(heading_rad - heading) < 0.03


BAGS: dict[str, Callable[[Path], Path]] = {
    "mcap": sources.rosbag2,
    "sqlite": partial(sources.rosbag2, sqlite=True),
    "mcap-packed": partial(sources.rosbag2, packed=True),
    "sqlite-packed": partial(sources.rosbag2, sqlite=True, packed=True),
    "stamped": partial(sources.rosbag2, stamped=True),
    "rgb8": partial(sources.rosbag2, raw="rgb8"),
    "bgr8": partial(sources.rosbag2, raw="bgr8"),
    "yuv422": partial(sources.rosbag2, raw="yuv422"),
    "webp": partial(sources.rosbag2, suffix=".webp"),
}


@pytest.mark.parametrize("kind", BAGS)
def test_a_bag_is_imported(kind: str, tmp_path: Path) -> None:
    report, tally = imported(BAGS[kind](tmp_path / "bag"), "rosbag2", tmp_path / "out")
    episode = episode_of(report)
    check_drive(episode, blurred=3)
    facts = (episode.outcome, episode.goal, episode.purpose, episode.robot)
    assert facts == ("found", "victim", "drive", "burger")
    assert (episode.camera.focal_px, episode.camera.lens) == (pytest.approx(45.0), "plumb_bob")
    assert report.odometry == "of the source"
    assert "images from /camera/image, velocities from /cmd_vel" in tally.lines()


@pytest.mark.parametrize("suffix", ["mcap", "db3"])
def test_bag_file_is_imported_when_camera_is_grey(suffix: str, tmp_path: Path) -> None:
    (file,) = sources.rosbag2(tmp_path / "bag", sqlite=suffix == "db3", raw="mono8").glob(
        f"*.{suffix}"
    )
    report, _ = imported(file, "rosbag2", tmp_path / "out")
    assert report.ticks == len(MADE)
    pixels = decode_image(bytes(episode_of(report).images[0]))
    assert np.abs(pixels[..., 0].astype(int) - pixels[..., 2]).max() <= 2


def test_import_names_the_format_of_images(tmp_path: Path) -> None:
    for how, named in (
        ({"suffix": ".webp"}, f"{len(MADE)} images of the format WebP are converted to JPEG"),
        ({"raw": "bgr8"}, f"{len(MADE)} images of the format bgr8 are converted to JPEG"),
        (
            {"suffix": "depth"},
            "images show depth (compressedDepth); choose the colour images with --camera",
        ),
    ):
        bag = sources.rosbag2(tmp_path / named[:40] / "bag", **how)
        assert named in imported(bag, "rosbag2", tmp_path / "out")[1].lines()
    bag = sources.rosbag2(tmp_path / "rvl/bag", suffix="rvl")
    with pytest.raises(ImportFailure, match=r"images \(16UC1; compressedDepth rvl\) are damaged"):
        imported(bag, "rosbag2", tmp_path / "out")
    bag = sources.rosbag2(tmp_path / "bag", raw="32FC1")
    with pytest.raises(ImportFailure, match="images have the unsupported encoding 32FC1"):
        imported(bag, "rosbag2", tmp_path / "out")


@pytest.mark.parametrize("rotate_deg", [90, 180, 270])
def test_image_stands_upright_when_it_is_rotated(rotate_deg: int, tmp_path: Path) -> None:
    folder = sources.csv_folder(tmp_path / "set", 10.0, png=True)
    for file in folder.glob("*.png"):
        lying = np.rot90(cv2.imread(str(file)), rotate_deg // 90)
        cv2.imwrite(str(file), lying)
    report, _ = imported(folder, "folder", tmp_path / "out", rotate_deg=rotate_deg)
    check_drive(episode_of(report))


def test_large_image_is_shrunk_when_it_is_portrait(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(images, "_MOST", (64, 48))
    folder = sources.csv_folder(tmp_path / "set", 10.0)
    lying = episode_of(imported(folder, "folder", tmp_path / "lying")[0])
    assert decode_image(bytes(lying.images[0])).shape == (48, 64, 3)
    rotated = episode_of(imported(folder, "folder", tmp_path / "out", rotate_deg=90)[0])
    assert decode_image(bytes(rotated.images[0])).shape == (48, 36, 3)


def test_calibration_is_rotated_with_its_images(tmp_path: Path) -> None:
    report, _ = imported(
        sources.rosbag2(tmp_path / "bag"), "rosbag2", tmp_path / "out", rotate_deg=90
    )
    camera = episode_of(report).camera
    # The principal point was 32 of 64 columns and 20 of 48 rows: the rows become the columns.
    assert (camera.width, camera.height, camera.focal_px) == (48, 64, pytest.approx(45.0))
    assert (camera.centre_x_px, camera.centre_y_px) == pytest.approx((28.0, 32.0))
    assert report.field_of_view_deg == pytest.approx(camera_of(camera).field_deg)


def test_a_bag_without_commands_has_those_of_its_odometry(tmp_path: Path) -> None:
    report, tally = imported(
        sources.rosbag2(tmp_path / "bag", command=False), "rosbag2", tmp_path / "out"
    )
    check_drive(episode_of(report))
    assert "images from /camera/image, velocities from /odom" in tally.lines()


def test_a_bag_without_odometry_has_a_way_reckoned_from_commands(tmp_path: Path) -> None:
    bag = sources.rosbag2(tmp_path / "bag", odometry=False)
    report, _ = imported(bag, "rosbag2", tmp_path / "out")
    assert report.odometry == "computed from velocities"
    check_drive(episode_of(report), blurred=3, within_m=0.15)  # a command is up to 0.1 s late
    report, _ = imported(bag, "rosbag2", tmp_path / "without", reckon=False)
    assert (report.odometry, episode_of(report).odometry) == ("none", {})


@pytest.mark.parametrize("video", [True, False], ids=["video", "images"])
@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
def test_a_lerobot_data_set_is_imported(version: str, video: bool, tmp_path: Path) -> None:
    dataset = sources.lerobot(tmp_path / "set", version, video=video)
    report, tally = imported(dataset, "lerobot", tmp_path / "out")
    assert len(report.files) == 2
    assert report.turn_rate == pytest.approx(0.8, rel=0.01)  # LeKiwi's degrees became radians
    for file in report.files:
        check_drive(episode_of(file))
    assert not [line for line in tally.lines() if "announces" in line]
    report, _ = imported(dataset, "lerobot", tmp_path / "one", episodes=("1",))
    assert [Path(file).name[:2] for file in report.files] == ["1-"]


LEKIWI = ["arm_wrist.pos", "x.vel", "y.vel", "theta.vel"]


@pytest.mark.parametrize(
    ("names", "fields"),
    [
        ([LEKIWI], {}),
        ({"motors": LEKIWI}, {}),
        ({"arm": LEKIWI[:1], "base": LEKIWI[1:]}, {}),
        ({name: index for index, name in enumerate(LEKIWI)}, {}),
        (["arm", "linear.x", "linear.y", "angular.z"], {"turn_rate": float(np.radians(1.0))}),
        (["arm", "base_vx", "base_vy", "base_omega"], {"turn_rate": float(np.radians(1.0))}),
        ([["arm", "go", "side", "turn"]], {"velocity": "go,turn"}),
        (None, {"velocity": "1,3"}),
    ],
    ids=["nested", "motors", "parts", "numbered", "twist", "base", "named", "none"],
)
def test_velocities_are_found_by_their_names(
    names: object, fields: dict[str, object], tmp_path: Path
) -> None:
    dataset = sources.lerobot(tmp_path / "set", video=False, episodes=1)
    info = json.loads((dataset / "meta/info.json").read_text())
    info["features"]["action"]["names"] = names
    (dataset / "meta/info.json").write_text(json.dumps(info))
    if "velocity" in fields:
        fields = fields | {"turn_rate": float(np.radians(1.0))}
    check_drive(episode_of(imported(dataset, "lerobot", tmp_path / "out", **fields)[0]))


def test_velocities_are_numbered_when_there_is_no_action(tmp_path: Path) -> None:
    dataset = sources.lerobot(tmp_path / "set", video=False, episodes=1)
    info = dataset / "meta/info.json"
    info.write_text(info.read_text().replace('"action"', '"observation.state"'))
    (file,) = dataset.glob("data/*/*.parquet")
    table = pq.read_table(file)
    names = [name.replace("action", "observation.state") for name in table.column_names]
    pq.write_table(table.rename_columns(names), file)
    report, _ = imported(dataset, "lerobot", tmp_path / "out", velocity="1,3")
    check_drive(episode_of(report))


@pytest.mark.parametrize(
    ("form", "option"),
    [
        ("rosbag2", {"rate_hz": 10.0}),
        ("lerobot", {"rate_hz": 10.0}),
        ("donkeycar", {"odometry": "/odom"}),
        ("folder", {"velocity": "a,b"}),
    ],
)
def test_option_without_effect_is_refused(
    form: str, option: dict[str, object], tmp_path: Path
) -> None:
    with pytest.raises(ImportFailure, match=r"--\w+ has no effect on a \w+; omit it"):
        imported(FORMATS[form](tmp_path / "source"), form, tmp_path / "out", **option)


def test_tub_is_one_drive_when_its_clock_steps_back(tmp_path: Path) -> None:
    def change(record: dict[str, object]) -> None:
        if int(str(record["_index"])) >= 30:
            record["_timestamp_ms"] = int(str(record["_timestamp_ms"])) - 3000

    tub = sources.donkeycar(tmp_path / "tub", change=change)
    report, tally = imported(tub, "donkeycar", tmp_path / "out")
    check_drive(episode_of(report))
    assert any("the clock is set back by 3.0 s" in line for line in tally.lines())


def test_dataset_counts_sideways_when_velocities_are_named(
    tmp_path: Path,
) -> None:
    dataset = sources.lerobot(tmp_path / "set", video=False, episodes=1)
    info = dataset / "meta/info.json"
    text = info.read_text().replace("x.vel", "thrust").replace("theta.vel", "yaw")
    info.write_text(text.replace('"y.vel"', '"z"').replace("arm_wrist.pos", "y.vel"))
    wishes = {"velocity": "thrust,yaw", "turn_rate": float(np.radians(1.0))}
    report, tally = imported(dataset, "lerobot", tmp_path / "out", **wishes)
    check_drive(episode_of(report))
    assert f"{FRAMES} frames go sideways, without a matching action" in tally.lines()


def test_tub_has_odometry_when_speeds_are_given(tmp_path: Path) -> None:
    report, tally = imported(sources.donkeycar(tmp_path / "tub"), "donkeycar", tmp_path / "out")
    episode = episode_of(report)
    check_drive(episode)
    assert (report.odometry, report.metric) == ("none", False)
    assert tally.lines() == [f"{FRAMES - len(MADE)} frames between two ticks are not needed"]
    # What was JPEG is the same JPEG, to the byte.
    assert (tmp_path / "tub/images/0_cam_image_array_.jpg").read_bytes() in bytes(episode.images[0])
    report, _ = imported(
        tmp_path / "tub", "donkeycar", tmp_path / "metric", speed=4.0, turn_rate=0.8 / 0.3
    )
    assert report.odometry == "computed from velocities"
    way = episode_of(report)
    assert (way.odometry[15].pose[0], way.odometry[19].pose[2]) == (
        pytest.approx(3.0, abs=0.02),
        pytest.approx(0.32, abs=0.02),
    )


def test_tub_has_a_gap_when_records_are_not_by_a_person(tmp_path: Path) -> None:
    def change(record: dict[str, object]) -> None:
        record["_session_id"] = f"s{int(str(record['_index'])) // 40}"
        if int(str(record["_index"])) >= 60:
            record["user/mode"] = "local"

    tub = sources.donkeycar(tmp_path / "tub", change=change, deleted=tuple(range(10, 20)))
    report, tally = imported(tub, "donkeycar", tmp_path / "out")
    assert "10 records were deleted by their owner" in tally.lines()
    assert f"{FRAMES - 60} records were not driven by a person" in tally.lines()
    assert [Path(file).name[:2] for file in report.files] == ["s0", "s1"]
    ticks = set(episode_of(report).images)
    assert max(ticks) == 19
    assert not {6, 7, 8} & ticks


def test_a_tub_with_the_times_of_its_copying_wants_a_rate(tmp_path: Path) -> None:
    tub = sources.donkeycar(
        tmp_path / "tub", change=lambda record: record.update(_timestamp_ms=3 * record["_index"])
    )
    with pytest.raises(Exception, match="333 frames per second"):
        imported(tub, "donkeycar", tmp_path / "out")
    check_drive(episode_of(imported(tub, "donkeycar", tmp_path / "out", rate_hz=20.0)[0]))


@pytest.mark.parametrize("time", ["milliseconds", "timestamp"])
def test_tub_of_version_1_is_imported(time: str, tmp_path: Path) -> None:
    tub = sources.first_tub(tmp_path / "tub", time=time)
    (tub / "exclude.json").write_text("[1, 2]")
    _, tally = imported(tub, "donkeycar", tmp_path / "out", reckon=False)
    (tub / "exclude.json").unlink()
    assert "2 records were deleted by their owner" in tally.lines()
    check_drive(episode_of(imported(tub, "donkeycar", tmp_path / "whole")[0]))


def test_tub_wants_a_rate_when_it_has_no_times(tmp_path: Path) -> None:
    tub = sources.first_tub(tmp_path / "tub", time="none")
    with pytest.raises(ImportFailure, match="if it has no times, give the frame rate with --rate"):
        imported(tub, "donkeycar", tmp_path / "out")
    check_drive(episode_of(imported(tub, "donkeycar", tmp_path / "out", rate_hz=20.0)[0]))


def test_tub_has_two_drives_when_it_was_appended(tmp_path: Path) -> None:
    tub = sources.first_tub(tmp_path / "tub")
    for index in range(41, FRAMES + 1):
        file = tub / f"record_{index}.json"
        record = json.loads(file.read_text())
        file.write_text(json.dumps(record | {"milliseconds": record["milliseconds"] - 1950}))
    report, _ = imported(tub, "donkeycar", tmp_path / "out")
    assert len(report.files) == 2
    assert report.ticks == len(MADE)


def test_each_tub_of_a_folder_is_a_drive(tmp_path: Path) -> None:
    car = tmp_path / "mycar"
    check = {"data/tub_1_18-05-05": sources.first_tub, "data/new": sources.donkeycar}
    for name, write in check.items():
        write(car / name)
    (car / "data/broken").mkdir()
    (car / "data/broken/manifest.json").write_text("[]")
    report, tally = imported(car, "donkeycar", tmp_path / "out")
    assert [Path(file).name[:16] for file in report.files] == [
        "data-new-" + Path(report.files[0]).name[9:16],
        "data-tub-1-18-05",
    ]
    for file in report.files:
        check_drive(episode_of(file))
    (broken,) = [line for line in tally.lines() if "broken" in line]
    assert "the manifest of a tub of version 2 has five lines" in broken


def test_fields_of_a_tub_are_those_of_its_manifest(tmp_path: Path) -> None:
    tub = sources.donkeycar(tmp_path / "tub")
    for file in tub.glob("*.*"):
        text = file.read_text().replace("user/angle", "steering").replace("cam/image_array", "eye")
        file.write_text(text.replace("user/throttle", "throttle"))
    check_drive(episode_of(imported(tub, "donkeycar", tmp_path / "out")[0]))
    for file in tub.glob("*.*"):
        file.write_text(file.read_text().replace("steering", "wheel"))
    with pytest.raises(ImportFailure, match="steering: 0 found; choose from eye, wheel, th"):
        imported(tub, "donkeycar", tmp_path / "out")
    named = imported(tub, "donkeycar", tmp_path / "named", velocity="wheel, throttle")
    check_drive(episode_of(named[0]))


@pytest.mark.parametrize(("rate_hz", "png"), [(20.0, True), (30.0, False)])
def test_a_folder_is_imported(rate_hz: float, png: bool, tmp_path: Path) -> None:
    report, _ = imported(
        sources.csv_folder(tmp_path / "set", rate_hz, png=png), "folder", tmp_path / "out"
    )
    assert report.odometry == "of the source"
    check_drive(episode_of(report), blurred=2)


def test_folder_is_mended_when_clock_and_odometry_are_reset(tmp_path: Path) -> None:
    folder = sources.csv_folder(tmp_path / "set")
    head, *lines = (folder / "drive.csv").read_text().splitlines()
    for at, line in enumerate(lines[30:], 30):
        time_s, image, linear, angular, x, *rest = line.split(",")
        # The robot drives straight ahead until then.
        reset = [str(float(time_s) - 1.0), image, linear, angular, str(float(x) - 3.0), *rest]
        lines[at] = ",".join(reset)
    (folder / "drive.csv").write_text("\n".join([head, *lines]))
    report, tally = imported(folder, "folder", tmp_path / "out")
    check_drive(episode_of(report), within_m=0.06)
    text = "\n".join(tally.lines())
    assert "the clock is set back by 1.0 s, 1.5 s after" in text
    assert "the drive: the odometry jumps by 2.90 m and 0 degrees at 1.5 s (joined" in text


def test_a_slow_camera_shows_frames_twice(tmp_path: Path) -> None:
    report, tally = imported(sources.csv_folder(tmp_path / "set", 5.0), "folder", tmp_path / "out")
    assert tally.counts["ticks show the frame of the tick before"] == report.ticks - len(
        sources.drive(5.0)
    )


def test_outcome_follows_the_user_before_the_source(tmp_path: Path) -> None:
    folder = sources.csv_folder(tmp_path / "set")
    text = (folder / "drive.csv").read_text().splitlines()
    (folder / "drive.csv").write_text(
        "\n".join([text[0] + ",success", *(line + ",0" for line in text[1:])])
    )
    for success, outcome in ((None, "aborted"), (True, "found"), (False, "aborted")):
        report, _ = imported(folder, "folder", tmp_path / f"out-{success}", success=success)
        assert episode_of(report).outcome == outcome


def test_a_part_of_a_drive_can_be_cut_out(tmp_path: Path) -> None:
    report, _ = imported(
        sources.csv_folder(tmp_path / "set"), "folder", tmp_path / "out", from_s=1.5, to_s=2.25
    )
    assert set(atoms_of(episode_of(report))) == {"left", "right"}


FORMATS: dict[str, Callable[[Path], Path]] = {
    "rosbag2": sources.rosbag2,
    "lerobot": partial(sources.lerobot, episodes=1),
    "donkeycar": sources.donkeycar,
    "folder": sources.csv_folder,
}


@pytest.mark.parametrize("form", FORMATS)
def test_refusal_names_the_command_for_another_format(form: str, tmp_path: Path) -> None:
    source = FORMATS[form](tmp_path / "source")
    other = "folder" if form != "folder" else "lerobot"
    with pytest.raises(
        ImportFailure, match=f"not of the format {other}; run: smal import {form} /"
    ):
        imported(source, other, tmp_path / "out")


def test_refusal_names_the_folder_of_a_table(tmp_path: Path) -> None:
    folder = sources.csv_folder(tmp_path / "set")
    with pytest.raises(ImportFailure, match=f"run: smal import folder {folder}$"):
        imported(folder / "drive.csv", "folder", tmp_path / "out")


def test_refusal_names_the_files_that_are_there(tmp_path: Path) -> None:
    for name in ("a.jpg", "b.jpg", "c.txt"):
        (tmp_path / name).touch()
    with pytest.raises(
        ImportFailure, match=r"CSV files to choose from; files there: 2 .jpg, 1 .txt"
    ):
        imported(tmp_path, "folder", tmp_path.parent / "out")


@pytest.mark.parametrize("form", ["donkeycar", "rosbag2"])
def test_imported_drive_teaches_localisation(form: str, tmp_path: Path) -> None:
    report, _ = imported(FORMATS[form](tmp_path / "source"), form, tmp_path / "out")
    teacher = Teacher(corridor.FEATURES, shortest=2)
    teacher.read(Path(report.files[0]))
    (demonstration,) = teacher.teaching.demonstrations
    assert demonstration.successful
    model = learn([demonstration], corridor.FEATURES)
    localizer = Localizer(model)
    visual_map = model.mapped
    errors = []
    for tick, moment in enumerate(sources.drive(10.0)):
        raw = extract(moment.image, corridor.FEATURES)
        belief = localizer.observe(raw, moment.pose, [demonstration.atoms[max(tick - 1, 0)]])
        errors.append(abs(int(visual_map.keyframes[belief.summary(1).keyframes[0]]) - tick))
        assert belief.lost < 0.5
    assert np.mean(errors[5:]) < 3.0


@pytest.mark.parametrize(("form", "ahead"), [("donkeycar", 0.6), ("folder", 0.0)])
def test_imported_turn_keeps_its_forward_speed(form: str, ahead: float, tmp_path: Path) -> None:
    """The car turns at 0.3 of full throttle and drives straight on at 0.5."""
    report, _ = imported(FORMATS[form](tmp_path / "source"), form, tmp_path / "out", reckon=False)
    teacher = Teacher(corridor.FEATURES, shortest=2)
    teacher.read(Path(report.files[0]))
    (demonstration,) = teacher.teaching.demonstrations
    turns = (demonstration.atoms == Atom.LEFT) | (demonstration.atoms == Atom.RIGHT)
    assert np.median(demonstration.ahead[turns]) == pytest.approx(ahead, abs=1e-4)


def test_import_names_are_stable_and_differ_by_source(tmp_path: Path) -> None:
    one = sources.csv_folder(tmp_path / "one")
    other = sources.csv_folder(tmp_path / "other", 30.0)
    reports = [
        imported(folder, "folder", tmp_path / out)[0]
        for folder, out in ((one, "a"), (one, "b"), (other, "c"))
    ]
    names = [Path(report.files[0]).name for report in reports]
    assert names[0] == names[1] != names[2]

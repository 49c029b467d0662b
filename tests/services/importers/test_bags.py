"""Bags as people record them: late, reset, with several topics, of ROS 1."""

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from services.importers.drive import ImportFailure, Tally
from services.importers.job import ImportReport
from services.kit.jpeg import decode_jpeg, encode_jpeg
from tests.services.importers import bags
from tests.services.importers.bags import (
    FRAMES,
    IMAGE,
    SPEED,
    Frame,
    Said,
    command,
    drive,
    image,
    odometry,
    said,
    since,
    write,
)
from tests.services.importers.test_formats import episode_of, imported

pytest.importorskip("rosbags", reason="needs the extra formats")
FORWARD = SPEED * 0.1 * (FRAMES - 1)  # Length of the drive, metres.


def imported_of(messages: list[Said], tmp_path: Path, **job: object) -> tuple[ImportReport, Tally]:
    sort = bool(job.pop("sort", True))
    bag = write(tmp_path / "bag", messages, sort=sort)
    return imported(bag, "rosbag2", tmp_path / "out", **job)


def check_whole(report: ImportReport, *, within_m: float = 0.02, frames: int = FRAMES) -> None:
    """Check that every frame has its own tick, view and pose."""
    (file,) = report.files
    episode = episode_of(file)
    assert sorted(episode.images) == sorted(episode.odometry) == list(range(frames))
    for tick, frame in enumerate(drive()[:frames]):
        assert frame.jpeg in bytes(episode.images[tick])
        x, y, heading = frame.pose
        assert episode.odometry[tick].pose[:2] == pytest.approx((x, y), abs=within_m)
        assert episode.odometry[tick].heading_rad == pytest.approx(heading, abs=0.05)
    assert report.atoms["stop"] <= 1


def remark(tally: Tally, *words: str) -> str:
    """Return the only remark with some words."""
    (found,) = [line for line in tally.lines() if all(word in line for word in words)]
    return found


def moved(messages: list[Said], topic: str, change: Callable[[int, Said], Said]) -> list[Said]:
    """Return messages with those of a topic changed, by their number within it."""
    count = iter(range(len(messages)))
    return [change(next(count), one) if one.topic == topic else one for one in messages]


def test_bag_of_ros_1_is_imported(tmp_path: Path) -> None:
    bag = write(tmp_path / "old.bag", said(), ros1=True)
    for form in ("rosbag1", "rosbag2"):
        report, _ = imported(bag, form, tmp_path / form)
        check_whole(report)


def test_bags_in_a_folder_are_a_drive_each(tmp_path: Path) -> None:
    (tmp_path / "bags").mkdir()
    write(tmp_path / "bags/monday.bag", said(), ros1=True)
    write(tmp_path / "bags/tuesday_0.bag", said(drive()[:60]), ros1=True)
    write(tmp_path / "bags/tuesday_1.bag", said(drive()[60:]), ros1=True)
    report, _ = imported(tmp_path / "bags", "rosbag1", tmp_path / "out")
    assert [len(episode_of(file).images) for file in report.files] == [FRAMES, FRAMES]


def test_bag_of_ros_1_keeps_its_calibration(tmp_path: Path) -> None:
    info = bags.calibration("/camera/camera_info")
    fields = {name.upper() if name == "k" else name: info.fields[name] for name in info.fields}
    bag = write(tmp_path / "old.bag", [info._replace(fields=fields), *said()], ros1=True)
    report, _ = imported(bag, "rosbag1", tmp_path / "out")
    assert episode_of(report).camera.focal_px == pytest.approx(45.0)


def test_camera_without_calibration_is_reported(tmp_path: Path) -> None:
    info = bags.calibration("/camera/camera_info")
    empty = info._replace(fields=info.fields | {"k": [0.0] * 9})
    report, tally = imported_of([empty, *said()], tmp_path)
    check_whole(report)
    assert remark(tally, "/camera/camera_info", "not calibrated")
    assert not [line for line in tally.lines() if "do not match their type" in line]


@pytest.mark.parametrize("episodes", [(), ("monday",)])
def test_bags_are_imported_when_another_is_damaged(
    episodes: tuple[str, ...], tmp_path: Path
) -> None:
    (tmp_path / "bags").mkdir()
    write(tmp_path / "bags/monday.bag", said(), ros1=True)
    (tmp_path / "bags/broken.bag").write_bytes(b"no bag")
    report, tally = imported(tmp_path / "bags", "rosbag1", tmp_path / "out", episodes=episodes)
    check_whole(report)
    assert any("broken.bag: damaged" in line for line in tally.lines()) == (not episodes)


def test_bags_in_folders_are_a_drive_each(tmp_path: Path) -> None:
    for day in ("monday", "tuesday"):
        (tmp_path / "bags").mkdir(exist_ok=True)
        write(tmp_path / "bags" / day, said())
    report, _ = imported(tmp_path / "bags", "rosbag2", tmp_path / "out")
    assert [Path(file).name.split("-")[0] for file in report.files] == ["monday", "tuesday"]


def test_failure_names_the_remarks(tmp_path: Path) -> None:
    still = [frame._replace(linear=0.0, angular=0.0) for frame in drive()]
    with pytest.raises(ImportFailure, match=r"never drives.*velocities from /cmd_vel"):
        imported_of(said(still, poses=False), tmp_path)


def test_bag_of_ros_1_without_index_is_refused(tmp_path: Path) -> None:
    bag = write(tmp_path / "old.bag", said(), ros1=True)
    data = bytearray(bag.read_bytes())
    at = data.index(b"index_pos=") + len(b"index_pos=")
    data[at : at + 8] = bytes(8)
    bag.write_bytes(data)
    with pytest.raises(ImportFailure, match=r"not indexed.*rosbag reindex"):
        imported(bag, "rosbag1", tmp_path / "out")


@pytest.mark.parametrize(
    "late_s", [lambda _k: 1.0, lambda k: 0.1 * (4 - k % 5) + 0.002 * (k % 5)], ids=["late", "burst"]
)
def test_images_have_their_time_of_capture_when_late(
    late_s: Callable[[int], float], tmp_path: Path
) -> None:
    late = moved(said(), IMAGE, lambda k, one: one._replace(received_s=one.received_s + late_s(k)))
    report, _ = imported_of(late, tmp_path)
    check_whole(report)


def test_images_are_sorted_when_network_swaps_them(tmp_path: Path) -> None:
    swapped = moved(
        said(), IMAGE, lambda k, _one: image(drive()[k ^ 1], late_s=0.1 * (k - (k ^ 1) + 1))
    )
    report, tally = imported_of(swapped, tmp_path, sort=False)
    check_whole(report)
    assert f"{FRAMES // 2} messages out of order" in remark(tally, IMAGE, "sorted")


def test_reception_is_reported_when_stamps_are_zero(tmp_path: Path) -> None:
    unset = moved(said(), IMAGE, lambda k, _one: image(drive()[k], stamp_s=0.0))
    report, tally = imported_of(unset, tmp_path)
    check_whole(report)
    assert remark(tally, IMAGE, "no time of capture", "time of reception is used")


def test_stamps_are_aligned_when_camera_counts_from_its_start(tmp_path: Path) -> None:
    uptime = moved(said(), IMAGE, lambda k, _one: image(drive()[k], stamp_s=12.0 + 0.1 * k))
    report, tally = imported_of(uptime, tmp_path)
    check_whole(report)
    assert remark(tally, IMAGE, "clock differs")


@pytest.mark.parametrize("ahead_s", [-8.0, 8.0, 1e9])
def test_commands_are_aligned_when_recorder_clock_differs(ahead_s: float, tmp_path: Path) -> None:
    """Stamps are of the robot's clock, and commands have the time of reception only."""
    other = [one._replace(received_s=one.received_s + ahead_s) for one in said()]
    report, _ = imported_of(other, tmp_path)
    check_whole(report)
    assert report.atoms["stop"] <= 1


@pytest.mark.parametrize("late_s", [-1.5, 0.8])
def test_images_are_aligned_by_their_view_when_clocks_differ(late_s: float, tmp_path: Path) -> None:
    """The delay could be that of a network, and no clock shows that it is not."""
    other = moved(
        said(),
        IMAGE,
        lambda k, _one: image(drive()[k], late_s=1.5, stamp_s=bags.BEGIN_S + 0.1 * k + late_s),
    )
    report, tally = imported_of(other, tmp_path)
    check_whole(report)
    assert remark(tally, f"the images are {late_s:.1f} s late", "aligned")


def test_message_before_the_clock_is_counted(tmp_path: Path) -> None:
    early = image(drive()[0], stamp_s=0.0)._replace(received_s=0.0)
    report, tally = imported_of([early, *said()], tmp_path)
    check_whole(report)
    assert f"1 messages of {IMAGE} have no time (sent before the clock)" in tally.lines()


@pytest.mark.parametrize("step_s", [-3.0, 30.0])
def test_clock_is_rejoined_when_set_during_a_drive(step_s: float, tmp_path: Path) -> None:
    frames = [
        frame._replace(time_s=frame.time_s + step_s * (k >= 60)) for k, frame in enumerate(drive())
    ]
    report, tally = imported_of(said(frames), tmp_path, sort=False)
    check_whole(report)
    words = (
        ("set back by 3.0 s, 6.0 s after",) if step_s < 0 else ("left out", "for 30.1 s at 5.9 s")
    )
    assert remark(tally, *words)


def test_command_is_used_when_it_fits_the_odometry(tmp_path: Path) -> None:
    other = [command(frame._replace(linear=0.0, angular=0.0), "/nav_vel") for frame in drive()]
    report, tally = imported_of([*said(), *other], tmp_path)
    check_whole(report)
    assert f"images from {IMAGE}, velocities from /cmd_vel" in tally.lines()
    assert "/nav_vel (120 messages, 10.0 Hz)" in remark(tally, "topics not used")


@pytest.mark.parametrize("linear", [0.0, 0.5])
@pytest.mark.parametrize("every", [FRAMES, 10], ids=["once", "once a second"])
def test_odometry_is_used_when_commands_are_few(linear: float, every: int, tmp_path: Path) -> None:
    few = [command(frame._replace(linear=linear, angular=0.0)) for frame in drive()[::every]]
    report, tally = imported_of([*said(commands=False), *few], tmp_path)
    check_whole(report)
    assert (report.speed, report.turn_rate) == (pytest.approx(SPEED), pytest.approx(0.5, abs=0.01))
    assert "velocities are those of the odometry" in remark(tally, "/cmd_vel", "drives at")


def test_velocities_follow_poses_when_twists_are_empty(tmp_path: Path) -> None:
    still = [odometry(frame._replace(linear=0.0, angular=0.0), "/slam") for frame in drive()]
    views = [image(frame) for frame in drive()]
    report, _ = imported_of([*views, *still], tmp_path)
    check_whole(report)
    assert report.speed == pytest.approx(SPEED, abs=0.01)


def test_measured_velocities_are_used_when_they_stand_alone(tmp_path: Path) -> None:
    kind = "geometry_msgs/msg/TwistWithCovarianceStamped"
    messages = moved(
        said(poses=False),
        "/cmd_vel",
        lambda _k, one: one._replace(
            kind=kind,
            fields={"header": bags.header(one.received_s), "twist": {"twist": one.fields}},
        ),
    )
    report, _ = imported_of(messages, tmp_path)
    check_whole(report, within_m=0.1)


def test_command_is_used_when_measured_twist_fits_better(tmp_path: Path) -> None:
    kind = "geometry_msgs/msg/TwistWithCovarianceStamped"
    measured = [
        one._replace(
            kind=kind,
            fields={"header": bags.header(one.received_s), "twist": {"twist": one.fields}},
        )
        for one in (command(frame, "/wheels") for frame in drive())
    ]
    late = [command(frame) for frame in drive()[20:]]
    _, tally = imported_of([*said(commands=False), *measured, *late], tmp_path)
    assert f"images from {IMAGE}, velocities from /cmd_vel" in tally.lines()


def test_odometry_is_chosen_by_content_when_none_is_called_odom(tmp_path: Path) -> None:
    views = [one for frame in drive() for one in (image(frame), command(frame))]
    dead = [odometry(frame, "/a/odometry", position={}) for frame in drive()]
    short = [odometry(frame, "/b/odometry") for frame in drive()[:30]]
    right = [odometry(frame, "/c/odometry") for frame in drive()]
    report, tally = imported_of([*views, *dead, *short, *right], tmp_path)
    check_whole(report)
    assert "odometry from /c/odometry" in tally.lines()
    report, tally = imported(tmp_path / "bag", "rosbag2", tmp_path / "b", odometry="/b/odometry")
    assert "odometry from /b/odometry" in tally.lines()


def test_cameras_are_listed_when_there_are_several(tmp_path: Path) -> None:
    rear = [image(frame, "/rear/image_raw/compressed") for frame in drive()]
    few = [image(frame, "/snapshot") for frame in drive()[:5]]
    wanted = r"/rear/image_raw/compressed \(120 messages, 10.0 Hz\); choose one with --camera"
    with pytest.raises(ImportFailure, match=wanted) as failure:
        imported_of([*said(), *rear, *few], tmp_path)
    assert "/snapshot" not in str(failure.value)
    report, tally = imported(tmp_path / "bag", "rosbag2", tmp_path / "front", camera=IMAGE)
    check_whole(report)
    assert "/rear/image_raw/compressed" in remark(tally, "topics not used")


@pytest.mark.parametrize(
    ("images", "info"),
    [
        ("/image_raw/compressed", "/camera_info"),
        ("/robot/front/image_raw", "/robot/front/camera_info"),
        ("/video", "/calibrated/camera_info"),
    ],
)
def test_calibration_is_found_beside_or_by_its_frame(
    images: str, info: str, tmp_path: Path
) -> None:
    messages = [one for frame in drive() for one in (image(frame, images), odometry(frame))]
    report, _ = imported_of([bags.calibration(info), *messages], tmp_path)
    assert episode_of(report).camera.focal_px == pytest.approx(45.0)


def test_poses_without_meaning_are_counted(tmp_path: Path) -> None:
    wild = {"orientation": {"x": 1e300}, "position": {"x": math.inf}}
    messages = moved(
        said(), "/odom", lambda k, one: odometry(drive()[k], **wild) if k == 7 else one
    )
    report, tally = imported_of(messages, tmp_path)
    check_whole(report)
    assert "1 poses are not finite or too far away" in tally.lines()


def test_sideways_motion_is_reported_with_its_times(tmp_path: Path) -> None:
    aside = [
        command(frame._replace(linear=0.0 if 30 <= k < 60 else SPEED), aside=SPEED * (30 <= k < 60))
        for k, frame in enumerate(drive())
    ]
    _, tally = imported_of([*said(commands=False, poses=False), *aside], tmp_path)
    assert remark(tally, "/cmd_vel goes sideways", "at 3.0 to 5.9 s")


@pytest.mark.parametrize("velocities", ["of commands", "of odometry", "of poses"])
@pytest.mark.parametrize("every", [18, 50])
def test_odometry_is_joined_when_it_was_reset(velocities: str, every: int, tmp_path: Path) -> None:
    frames = list(drive())
    for at in range(every, FRAMES, every):
        frames[at:] = since(frames[at:], frames[at])
    if velocities == "of poses":
        frames = [frame._replace(linear=0.0, angular=0.0) for frame in frames]
    report, tally = imported_of(said(frames, commands=velocities == "of commands"), tmp_path)
    check_whole(report, within_m=0.06)
    assert report.speed == pytest.approx(SPEED, abs=0.01)
    assert remark(tally, "the odometry jumps by", f" at {every / 10 - 0.05:.1f} s (joined")


def test_drive_is_cut_when_the_view_jumps_with_the_pose(tmp_path: Path) -> None:
    back = [
        frame._replace(time_s=6.0 + frame.time_s, jpeg=drive()[119 - k].jpeg)
        for k, frame in enumerate(drive()[:60])
    ]
    report, tally = imported_of(said([*drive()[:60], *back]), tmp_path)
    episodes = [episode_of(file) for file in report.files]
    assert [len(episode.images) for episode in episodes] == [60, 60]
    assert [episode.outcome for episode in episodes] == ["aborted", "found"]
    assert remark(tally, "at 6.0 s (the drive is cut there")


def test_second_publisher_of_odometry_is_left_out(tmp_path: Path) -> None:
    other = [
        odometry(frame._replace(time_s=frame.time_s + 0.03, pose=(frame.pose[0] + 1.0, -1.0, 0.7)))
        for frame in drive()[::2]
    ]
    report, tally = imported_of([*said(), *other], tmp_path)
    check_whole(report)
    assert remark(tally, "60 of 180 poses contradict the others", "0.0 to 11.8 s")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"position": {}, "orientation": {"w": 1.0}}, "never moves"),
        ({"orientation": {}}, "never turns"),
    ],
    ids=["constant", "zero quaternion"],
)
def test_odometry_follows_velocities_when_poses_stand(
    change: dict[str, object], words: str, tmp_path: Path
) -> None:
    wrong = [
        one
        for frame in drive()
        for one in (image(frame), command(frame), odometry(frame, **change))
    ]
    report, tally = imported_of(wrong, tmp_path)
    check_whole(report, within_m=0.05)
    assert "computed from the velocities" in remark(tally, words)


@pytest.mark.parametrize("unit", [1000.0, 100.0])
def test_odometry_is_in_metres_when_published_in_smaller_units(unit: float, tmp_path: Path) -> None:
    small = [
        frame._replace(pose=(unit * frame.pose[0], unit * frame.pose[1], frame.pose[2]))
        for frame in drive()
    ]
    report, tally = imported_of(said(small), tmp_path)
    check_whole(report)
    assert remark(tally, "converted to metres")


def mirrored(frame: Frame) -> Frame:
    x, y, heading = frame.pose
    return frame._replace(pose=(x, -y, -heading))


def test_odometry_is_mirrored_when_views_and_commands_agree(tmp_path: Path) -> None:
    left_handed = [one for one in said(map(mirrored, drive())) if one.topic != "/cmd_vel"]
    report, tally = imported_of([*left_handed, *map(command, drive())], tmp_path)
    check_whole(report)
    assert remark(tally, "turns of the odometry are to the other side", "mirrored")


def test_commands_are_mirrored_when_views_and_odometry_agree(tmp_path: Path) -> None:
    others = [command(frame._replace(angular=-frame.angular)) for frame in drive()]
    report, tally = imported_of([*said(commands=False), *others], tmp_path)
    check_whole(report)
    assert report.atoms["left"] == sum(frame.angular > 0.0 for frame in drive())
    assert remark(tally, "turns of the velocities are to the other side", "mirrored")


@pytest.mark.parametrize("how", ["lens", "turn rate"])
def test_remark_names_the_remedy_when_views_turn_otherwise(how: str, tmp_path: Path) -> None:
    upside_down = [
        frame._replace(jpeg=encode_jpeg(np.rot90(decode_jpeg(frame.jpeg), 2).copy()))
        for frame in drive()
    ]
    clockwise = [frame._replace(angular=-frame.angular) for frame in map(mirrored, drive())]
    bag = said(upside_down if how == "lens" else clockwise)
    _, tally = imported_of(bag, tmp_path)
    assert remark(tally, "the views turn to the other side", "--rotate 180", "--turn-rate -1")
    remedy = {"rotate_deg": 180} if how == "lens" else {"turn_rate": -1.0}
    report, tally = imported(tmp_path / "bag", "rosbag2", tmp_path / "out", **remedy)
    assert "other side than the robot" not in " ".join(tally.lines())
    assert report.atoms["left"] == sum(frame.angular > 0.0 for frame in drive())


def test_turn_rates_in_degrees_are_refused_with_a_scale(tmp_path: Path) -> None:
    degrees = [command(frame._replace(angular=math.degrees(frame.angular))) for frame in drive()]
    with pytest.raises(ImportFailure, match=r"turn rate too large .29 rad/s.*--turn-rate 0.0174"):
        imported_of([*said(commands=False), *degrees], tmp_path)
    report, _ = imported(tmp_path / "bag", "rosbag2", tmp_path / "out", turn_rate=math.radians(1.0))
    check_whole(report)
    assert report.turn_rate == pytest.approx(0.5, abs=0.01)


def test_standing_poses_are_reported_when_commands_drive(tmp_path: Path) -> None:
    blocked = [
        frame._replace(pose=drive()[40].pose) if 40 <= k < 90 else frame
        for k, frame in enumerate(drive())
    ]
    blocked[90:] = since(drive()[40:70], drive()[0])
    blocked = [frame._replace(time_s=0.1 * k) for k, frame in enumerate(blocked)]
    _, tally = imported_of(said(blocked), tmp_path)
    assert remark(tally, "the odometry stands although the velocities drive", "4.0 to 8.0 s")


def test_pause_is_reported_when_the_robot_drove_on(tmp_path: Path) -> None:
    frames = [frame for k, frame in enumerate(drive()) if not 50 <= k < 75]
    report, tally = imported_of(said(frames), tmp_path)
    ticks = set(episode_of(report).images)
    assert max(ticks) == FRAMES - 1
    assert not ticks & set(range(53, 72))
    assert remark(tally, "no image for 2.6 s at 4.9 s")


def test_poses_agree_with_commands_in_other_units(tmp_path: Path) -> None:
    joystick = [command(frame._replace(linear=1.6)) for frame in drive()]
    report, tally = imported_of([*said(commands=False), *joystick], tmp_path)
    check_whole(report)
    assert "0.25 times as far as the velocities" not in " ".join(tally.lines())
    assert math.isclose(report.speed, 1.6)
    assert np.isfinite(report.turn_rate)

"""The tracker: images in, poses out, over a real router; lost and found tags are logged."""

import math

import pytest

from schemas import topics
from schemas.camera import Calibration, OverheadImage
from schemas.motion import TrackedPose
from services.kit.bus import Bus
from services.kit.jpeg import encode_jpeg
from services.kit.node import Node, ServiceError
from services.kit.settings import ServiceSettings
from services.simulator.robots import TURTLEBOT
from services.tracker.service import TrackerService, TrackerSettings
from services.tracker.tag_tracking import Tag
from tests.services.chain import process
from tests.services.conftest import RunNode
from tests.services.tracker.overhead_images import Shot, photograph
from tests.services.waiting import collected, eventually, introduce, malformed, ready, status_of

TAG = Tag(number=7, side_m=0.2, height_m=0.43)
SIZE = (400, 300)
CALIBRATION = Calibration(
    focal_px=560.0, centre_x_px=190.0, centre_y_px=160.0, x_m=4.0, y_m=3.0, height_m=4.2, up_rad=0.7
)


def pose_at(tick: int) -> tuple[float, float, float]:
    """Return where the robot is: on a circle about the camera."""
    phi = 0.3 * tick
    return (
        4.0 + 0.5 * math.cos(phi),
        3.0 + 0.5 * math.sin(phi),
        math.remainder(phi + math.pi / 2, math.tau),
    )


def frame(
    tick: int, *tags: Tag, calibration: Calibration = CALIBRATION, episode: str = "e"
) -> OverheadImage:
    """Return the overhead image of a tick."""
    pixels = photograph(Shot(CALIBRATION, SIZE, pose_at(tick), seed=tick), *tags)
    return OverheadImage(
        robot="rescuebot", episode=episode, tick=tick, stamp_ns=1000 + tick, width=SIZE[0], height=SIZE[1],
        data=encode_jpeg(pixels), calibration=calibration,
    )  # fmt: skip


def check(answer: TrackedPose, tick: int) -> None:
    """Check that an answer is the true pose of its tick."""
    x, y, heading = pose_at(tick)
    assert (answer.tick, answer.stamp_ns, answer.visible) == (tick, 1000 + tick, True)
    assert math.hypot(answer.x_m - x, answer.y_m - y) < 0.01
    assert abs(math.degrees(math.remainder(answer.heading_rad - heading, math.tau))) < 1.0


@pytest.mark.zenoh
def test_a_drive_over_the_bus(client: Bus, router_endpoint: str) -> None:
    poses = collected(client, topics.TRACKED)
    with process("tracker", router_endpoint) as child:
        ready(client, "tracker")
        introduce(client, "tracker", frame(500, TAG, episode="hello"))
        malformed(client, "tracker", topics.OVERHEAD)

        def answered(message: OverheadImage) -> bool:
            client.publish(message)
            return bool(poses)

        eventually(lambda: answered(frame(500, TAG, episode="hello")))
        for tick in range(12):
            client.publish(frame(tick, TAG) if tick not in (4, 5, 6) else frame(tick))
            eventually(lambda tick=tick: poses[-1].tick == tick)
        status = status_of(client, "tracker")
    assert (status.detail["tag"], status.detail["lost"], status.failed) == (7, 3, 0)
    assert status.detail["seen"] == status.received["camera/overhead"] - 3
    heard = {pose.tick: pose for pose in poses}
    for tick in (0, 1, 2, 3, 7, 8, 9, 10, 11):
        check(heard[tick], tick)
    for tick in (4, 5, 6):
        assert heard[tick] == TrackedPose.after(frame(tick), visible=False)
    log = child.stderr.read()
    assert log.count("lost the tag") == log.count("visible again") == 1
    assert "lost the tag at frame 4 of episode e: no markers with number 7 are in the image" in log
    assert "the tag is visible again at frame 7 of episode e" in log


def test_an_impossible_calibration_is_one_line_and_no_pose(
    client: Bus, settings: ServiceSettings, run_node: RunNode, caplog: pytest.LogCaptureFixture
) -> None:
    below = CALIBRATION.model_copy(update={"height_m": 0.4})
    service = TrackerService(TAG)
    with pytest.raises(ServiceError, match=r"^a camera 0\.4 m above the floor cannot look down"):
        service.handle(frame(0, TAG, calibration=below))
    node = Node("tracker", settings)
    node.subscribe(topics.OVERHEAD, service.handle)
    run_node(node)
    ready(client, "tracker")
    introduce(client, "tracker", frame(0, TAG))
    client.publish(frame(1, TAG, calibration=below))
    status = eventually(lambda: (now := status_of(client, "tracker")) and now.failed and now)
    assert status.published["pose/tracked"] == status.received["camera/overhead"] - 1
    # A failure is counted before it is logged.
    (line,) = eventually(
        lambda: [note.getMessage() for note in caplog.records if note.levelname == "WARNING"]
    )
    assert line.startswith("handling camera/overhead failed (1 failures in total): a camera 0.4 m")


def test_default_tag_is_the_tag_of_the_simulator() -> None:
    settings = TrackerSettings()
    on_robot = (TURTLEBOT.tag.number, TURTLEBOT.tag.side_m, TURTLEBOT.tag.height_m)
    assert (settings.tag_number, settings.tag_side_m, settings.tag_height_m) == on_robot

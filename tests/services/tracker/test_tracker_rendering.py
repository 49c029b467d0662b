"""A whole drive through the rendered laboratory, seen from above: the tracker against the true poses."""

import math
from collections.abc import Iterator
from itertools import pairwise

import numpy as np
import pytest

from schemas.base import Message
from services.simulator.robots import TURTLEBOT
from services.simulator.scene.rendering import SceneCamera
from services.simulator.sensors.camera import CameraSettings, overhead_message
from services.simulator.world import load_world
from services.simulator.world.place import Pose, World
from services.simulator.world.route import plan_route
from services.tracker.service import TrackerService
from services.tracker.tag_tracking import Tag

FRAME_S = 0.1
# Every tenth frame is checked: a frame takes a software renderer a tenth of a second.
EVERY = 10


def drive(world: World) -> Iterator[Pose]:
    """Yield the poses of a robot that follows the route and turns on the spot, up to where the victim is found."""
    route = plan_route(world, (world.start.x, world.start.y))
    heading = world.start.heading
    for here, there in pairwise(route):
        ahead = math.atan2(there[1] - here[1], there[0] - here[0])
        turn = math.remainder(ahead - heading, math.tau)
        for angle in np.arange(0.0, abs(turn), FRAME_S * TURTLEBOT.drive.turn_rate_rad_s):
            yield Pose(*here, heading + math.copysign(angle, turn))
        heading = ahead
        length = math.dist(here, there)
        for way in np.arange(0.0, length, FRAME_S * TURTLEBOT.drive.speed_m_s):
            x, y = here + (there - here) * way / length
            if math.dist((x, y), (world.victim.x, world.victim.y)) < world.scale.found_m:
                return
            yield Pose(x, y, heading)


@pytest.mark.rendering
def test_tracked_drive_is_within_3_cm_and_2_degrees() -> None:
    world = load_world("indoor")
    camera = SceneCamera(world, CameraSettings(width=64, height=48))
    tracker = TrackerService(
        Tag(TURTLEBOT.tag.number, TURTLEBOT.tag.side_m, TURTLEBOT.tag.height_m)
    )
    poses = list(drive(world))[::EVERY]
    assert len(poses) > 20
    for tick, pose in enumerate(poses):
        header = Message(robot="turtlebot", episode="drive", tick=tick, stamp_ns=tick)
        found = tracker.handle(
            overhead_message(header, camera.overhead(pose), world.place.overhead)
        )
        assert found.visible, pose
        assert math.dist((found.x_m, found.y_m), (pose.x, pose.y)) < 0.03
        assert abs(math.degrees(math.remainder(found.heading_rad - pose.heading, math.tau))) < 2.0

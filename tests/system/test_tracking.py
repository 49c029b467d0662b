"""A drive through the laboratory with real processes: the tracker's poses beside the true ones."""

import math
from pathlib import Path

import pytest

from schemas import topics
from schemas.motion import TrackedPose, TruePose
from schemas.rpc import ResetRequest
from services.cli.episodes.client import EpisodeClient
from services.cli.options import CameraOptions, Simulator
from services.cli.stack import stack_for
from services.expert.driver import ExpertService

pytestmark = [pytest.mark.rendering, pytest.mark.system]


def test_the_tracker_agrees_with_the_true_pose_on_a_drive(tmp_path: Path) -> None:
    simulator = Simulator(CameraOptions(64, 48)).flags("indoor")
    services = ("router", "robot", "tracker")
    with stack_for(None, services, "turtlebot", {"robot": simulator}, logs=tmp_path) as access:
        client = EpisodeClient("tracking", access.settings)
        expert = ExpertService()
        true: dict[int, TruePose] = {}
        tracked: dict[int, TrackedPose] = {}

        def see(pose: TruePose) -> object:
            true[pose.tick] = pose
            return expert.handle(pose)

        def follow(pose: TrackedPose) -> None:
            tracked[pose.tick] = pose

        client.node.subscribe(topics.POSE, see, depth=256)  # type: ignore[arg-type]
        client.node.subscribe(topics.TRACKED, follow, depth=256)
        request = ResetRequest(seed=1, purpose="drive", driver="expert", max_ticks=25)
        record = client.run(request, expert.begin, lambda: expert.arrived, check=access.check)
        client.node.spin(until=lambda: record.ticks in tracked, timeout_s=100.0)
        client.close()
    assert record.outcome == "timeout"
    seen = [tick for tick, pose in tracked.items() if pose.visible]
    away_m = [
        math.dist((true[tick].x_m, true[tick].y_m), (tracked[tick].x_m, tracked[tick].y_m))
        for tick in seen
    ]  # type: ignore[arg-type]
    turned_deg = [
        abs(
            math.degrees(
                math.remainder(true[tick].heading_rad - tracked[tick].heading_rad, math.tau)
            )
        )  # type: ignore[operator]
        for tick in seen
    ]
    # In lockstep the world waits for the driver, not for the tracker: a frame may give way to a newer one.
    assert len(tracked) >= 0.3 * len(true)
    assert len(seen) >= 0.98 * len(tracked)
    assert max(away_m) < 0.03
    assert max(turned_deg) < 2.0

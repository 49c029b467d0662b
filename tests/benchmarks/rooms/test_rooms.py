"""The rooms: free ways, and a drive in MuJoCo where it is installed."""

import numpy as np
import pytest

from schemas.rpc import ResetRequest
from services.experiments.evaluation.drives import drive_in
from services.robot.lockstep import SimulatorsTask, SteppedEpisode
from smal.features import FeatureSettings
from tests.benchmarks.rooms.scene import RADIUS_M, WAYS, clearance_m


@pytest.mark.parametrize("way", WAYS)
def test_way_of_the_rooms_is_free(way: str) -> None:
    *points, target = (np.array(point) for point in WAYS[way].points)
    for start, end in zip(points, [*points[1:], target], strict=True):
        for share in np.linspace(0.0, 1.0, 20):
            assert clearance_m(*(start + share * (end - start))) > 1.5 * RADIUS_M


@pytest.mark.rendering
def test_expert_reaches_the_target_in_mujoco() -> None:
    rooms = pytest.importorskip("tests.benchmarks.rooms.body")
    body = rooms.RoomsBody("workshop", width=64, height=48)
    request = ResetRequest(seed=1, purpose="drive", driver="expert", max_ticks=1000)
    episode = SteppedEpisode(body, SimulatorsTask(), request)
    assert episode.view.image.std() > 20.0  # Textured and lit.
    made = drive_in(episode, "rooms", FeatureSettings().of(["thumbnail"]))
    assert made["reached"]
    taught = WAYS["workshop"].points[-1]
    assert np.hypot(*(made["poses"][-1, :2] - taught)) < 0.7
    body.close()

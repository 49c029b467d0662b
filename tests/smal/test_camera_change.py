"""The pitch of a camera that was mounted anew, estimated in the first metres."""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from smal.camera_change import CameraPitch
from smal.features import Centering, FeatureSettings
from smal.features.percept import Percept, perceive
from smal.filter import Belief, Filter
from smal.map import VisualMap
from smal.model import Model
from smal.robot import Localizer
from tests.smal import synthetic_world
from tests.smal.synthetic_world import SCENE, Room, drive, taught

ROOM = Room()
USUAL = FeatureSettings()
Image = NDArray[np.uint8]


@cache
def usual_map() -> tuple[VisualMap, Centering]:
    """Learn the usual way on the usual features: color alone shows too little of a pitched view."""
    return taught(ROOM, drive(), settings=USUAL, scene=SCENE)


@pytest.fixture
def pitch_camera(monkeypatch: pytest.MonkeyPatch) -> Callable[[float], None]:
    """Return a function that points the camera of the rooms down by an angle in degrees."""
    rays = synthetic_world._rays

    def pitch(angle_deg: float) -> None:
        cos = math.cos(math.radians(angle_deg))
        sin = math.sin(math.radians(angle_deg))

        def pitched(*camera: object) -> tuple[NDArray[np.float64], ...]:
            down, right, ahead = rays(*camera)
            return cos * down + sin * ahead, right, cos * ahead - sin * down

        monkeypatch.setattr(synthetic_world, "_rays", pitched)

    return pitch


def followed(light: float = 1.0) -> Belief:
    """Return the belief after the taught drive under a share of the taught light."""
    mapped, centering = usual_map()
    localizer = Localizer(Model(centering, mapped))
    for pose in drive().poses:
        image = np.rint(light * ROOM.look(pose)).astype(np.uint8)
        located = localizer.locate(perceive(image, USUAL), pose.tolist())
    return located.belief


@pytest.mark.parametrize("pitch_deg", [-5.0, 5.0])
def test_pitch_is_estimated_when_the_camera_has_changed(
    pitch_camera: Callable[[float], None], pitch_deg: float
) -> None:
    usual_map()
    pitch_camera(pitch_deg)
    assert followed().pitch_deg == pitch_deg


@pytest.mark.parametrize("light", [0.6, 1.0])
def test_pitch_stays_when_only_the_light_has_changed(light: float) -> None:
    assert followed(light).pitch_deg == 0.0


def test_pitch_is_compared_only_when_the_robot_drives_along(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    mapped, centering = usual_map()
    localizer = Localizer(Model(centering, mapped))
    compared = list[tuple[float, float]]()

    def compare(_: object, __: Image, ___: int, certainty: float, lengths: float) -> None:
        compared.append((certainty, lengths))

    monkeypatch.setattr(CameraPitch, "compare", compare)
    for pose in drive().poses[:20]:
        localizer.locate(perceive(ROOM.look(pose), USUAL), pose.tolist())
    certainty, lengths = np.array(compared).T
    assert certainty[-1] > 0.9
    assert lengths.sum() > 1.0
    compared.clear()
    for turned in np.arange(0.0, math.pi, 0.08):
        there = pose + np.array([0.0, 0.0, turned])
        localizer.locate(perceive(ROOM.look(there), USUAL), there.tolist())
    certainty, lengths = np.array(compared).T
    assert certainty[-1] < 0.1
    assert lengths.sum() == pytest.approx(0.0, abs=1e-6)


def test_view_is_forgotten_when_a_lost_robot_drops_its_pitch(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    mapped, centering = usual_map()
    localizer = Localizer(Model(centering, mapped))
    belief = replace(followed(), pitch_deg=5.0, lost=1.0)
    pose = drive().poses[-1]
    blank = Percept(np.zeros(mapped.basis.shape[0]), None, ())
    forgotten = list[bool]()
    localizer.reset(belief, pose.tolist())
    monkeypatch.setattr(Filter, "forget_view", lambda _: forgotten.append(True))
    after = localizer.locate(blank, pose.tolist())
    assert after.belief.is_lost
    assert forgotten == [True]
    localizer.locate(blank, pose.tolist())
    assert forgotten == [True]


def test_pitch_lasts_when_another_localizer_takes_over(
    pitch_camera: Callable[[float], None],
) -> None:
    mapped, centering = usual_map()
    pitch_camera(5.0)
    localizer = Localizer(Model(centering, mapped))
    belief = replace(followed(), pitch_deg=5.0)
    pose = drive().poses[-1]
    localizer.reset(belief, pose.tolist())
    after = localizer.locate(perceive(ROOM.look(pose), USUAL), pose.tolist()).belief
    assert after.pitch_deg == 5.0
    assert after.cosine > 0.6


def test_pitch_stays_when_the_network_of_features_is_elsewhere(
    pitch_camera: Callable[[float], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    usual_map()
    pitch_camera(5.0)
    monkeypatch.setattr(FeatureSettings, "computable", False)
    monkeypatch.setattr("smal.camera_change.extract", None)
    assert followed().pitch_deg == 0.0


def test_levelled_percept_is_like_the_taught_one_when_pitched(
    pitch_camera: Callable[[float], None],
) -> None:
    mapped, centering = usual_map()
    pose = drive().poses[20]
    level = centering.apply(perceive(ROOM.look(pose), USUAL).features)
    pitch_camera(5.0)
    raw = perceive(ROOM.look(pose), USUAL)
    pitch = CameraPitch(mapped, centering)
    assert pitch.levelled(raw) is raw
    for _ in range(40):
        pitch.compare(raw.picture, int(np.abs(mapped.keyframes - 20).argmin()), 1.0, 1.0)
    before = float(level @ centering.apply(raw.features))
    after = float(level @ centering.apply(pitch.levelled(raw).features))
    assert after > before + 0.1

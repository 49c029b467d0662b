"""The simulated robot in one world after another, by name."""

import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from schemas.rpc import ResetRequest
from services.kit.going_on import asking
from services.kit.node import ServiceError
from services.simulator.base import KinematicBase
from services.simulator.body import SimulatedBody
from services.simulator.sensors.camera import CameraSettings
from services.simulator.simulation import Simulation
from services.simulator.variation import VARIATIONS
from services.simulator.world import load_world
from services.simulator.world.loading import WORLDS_FOLDER, Wishes, import_map
from services.simulator.worlds import SimulatorSettings, Worlds
from tests.services.simulator.simulator_driving import StubCamera

OWN = ["campus", "indoor", "terrace", "yard"]


@pytest.fixture
def made(tmp_path: Path) -> Path:
    """Give a root with a world of the user's own."""
    (tmp_path / "worlds").mkdir()
    source = tmp_path / "my town.osm"
    shutil.copy(WORLDS_FOLDER / "yard.osm", source)
    _, text = import_map(source, tmp_path / "worlds" / "my town.json", Wishes())
    (tmp_path / "worlds" / "my town.json").write_text(text)
    return tmp_path


def worlds_of(root: Path, **settings: Any) -> Worlds:
    return Worlds(
        SimulatorSettings(
            root=root, camera_width=64, camera_height=48, base="kinematic", **settings
        )
    )


@pytest.fixture
def opened(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, str]]:
    """Have worlds opened without rendering, and note which."""
    asked: list[tuple[str, str]] = []

    def open_one(world: str, _camera: CameraSettings, *, variation: str, **_: object) -> Simulation:
        asked.append((world, variation))
        there = load_world(world)
        return Simulation(there, StubCamera(), KinematicBase(there.place))

    monkeypatch.setattr("services.simulator.worlds.open_simulation", open_one)
    return asked


def begin(body: SimulatedBody, **wishes: str) -> None:
    body.begin(ResetRequest(seed=1, mode="realtime", **wishes))


def test_the_worlds_are_ours_the_user_s_and_the_first_one(made: Path) -> None:
    assert worlds_of(made, world="yard").names() == sorted([*OWN, "my town"])
    assert worlds_of(made / "worlds", world=str(made / "my town.osm")).names() == sorted(
        [*OWN, "my town"]
    )


def test_an_episode_begins_in_the_world_that_is_asked_for(
    made: Path, opened: list[tuple[str, str]]
) -> None:
    worlds = worlds_of(made, world="yard")
    body = SimulatedBody(worlds.open(), worlds=worlds)
    begin(body)
    begin(body, world="yard", variation="day")
    assert opened == [("yard", "day")], "it is there already"
    begin(body, world="indoor")
    assert (body.name, body.detail()["variation"]) == ("indoor", "day")
    begin(body, variation="dark")
    assert (body.name, body.detail()["variation"]) == ("indoor", "dark")
    begin(body, world="my town")
    assert (body.name, body.detail()["variation"]) == ("my town", "dark")
    begin(body)
    assert [variation for _, variation in opened] == ["day", "day", "dark", "dark"]
    assert str(body.detail()["worlds"]).split(", ") == worlds.names()
    assert str(body.detail()["variations"]).split(", ") == list(VARIATIONS)


@pytest.mark.parametrize(
    ("make", "why"),
    [
        (
            lambda _: None,
            "world 'bad' not found; choose from campus, indoor, my town, terrace, yard",
        ),
        (lambda path: path.symlink_to(WORLDS_FOLDER / "indoor.json"), "world 'bad': leads out of"),
        (os.mkfifo, "world 'bad' not found"),
    ],
)
def test_robot_stays_when_another_world_is_unusable(
    made: Path, opened: list[tuple[str, str]], make: Callable[[Path], object], why: str
) -> None:
    make(made / "worlds" / "bad.json")
    worlds = worlds_of(made, world="yard")
    body = SimulatedBody(Simulation(load_world("yard"), StubCamera()), worlds=worlds)
    with pytest.raises(ServiceError, match=why):
        begin(body, world="bad")
    assert opened == []
    with pytest.raises(ServiceError, match="variation 'bad' not found; choose from day, morning"):
        begin(body, variation="bad")
    begin(body)
    assert body.name == "yard"


class EnoughError(Exception):
    """The end of opening a world."""


def test_robot_stays_when_opening_a_world_is_cancelled(
    made: Path, opened: list[tuple[str, str]]
) -> None:
    def enough() -> None:
        raise EnoughError

    worlds = worlds_of(made, world="yard")
    body = SimulatedBody(worlds.open(), worlds=worlds)
    before = body.simulation
    with pytest.raises(EnoughError), asking(enough):
        begin(body, world="my town")
    assert (body.simulation, worlds.here) == (before, ("yard", "day"))
    begin(body, world="my town")
    assert (body.name, worlds.here) == ("my town", ("my town", "day"))

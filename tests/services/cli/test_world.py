"""``smal world``: a map in, a world file, a summary and views out."""

import math
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import shapely

from services.simulator.world import World, load_world
from services.simulator.world.route import obstacles_of, plan_route, route_length_m
from tests.services.cli.conftest import Smal
from tests.services.simulator.map_text import LATITUDE, LONGITUDE, block_of_houses
from tests.services.simulator.scans import laboratory

Imported = Callable[..., World]


@pytest.fixture
def imported(tmp_path: Path, smal: Smal) -> Imported:
    """Make a world of a map, with options."""

    def run(*options: object) -> World:
        source = block_of_houses().write(tmp_path / "map.osm")
        assert smal("world", "import", source, "--out", tmp_path / "map.json", *options)[0] == 0
        return load_world(tmp_path / "map.json")

    return run


def test_a_map_becomes_a_world_with_a_hidden_victim(tmp_path: Path, smal: Smal) -> None:
    made = block_of_houses()
    made.way([(0, 0), (5, 5)], building="yes")
    source = made.write(tmp_path / "map.osm")
    status, said, _ = smal("world", "import", source, "--out", tmp_path / "map.json")
    assert status == 0
    rows = {line[:40].strip(): line.split()[-1] for line in said.splitlines()}
    assert rows["buildings"] == "6"
    assert rows["building: its outline is not closed"] == "1"
    assert "0.48 km" in said
    world = load_world(tmp_path / "map.json")
    route = plan_route(world, (world.start.x, world.start.y))
    assert f"{route_length_m(route):.1f} m" in said
    sight = np.array([[(world.start.x, world.start.y), (world.victim.x, world.victim.y)]])
    assert not obstacles_of(world.place).in_sight(sight)[0]
    assert list(tmp_path.glob(".*")) == [], "no partial file is left"


def test_start_and_victim_by_hand(imported: Imported) -> None:
    world = imported("--start", "-60,-50,90", "--victim", "50,0")
    assert (world.start.x, world.start.y, world.start.heading) == (
        -60,
        -50,
        pytest.approx(math.pi / 2, abs=1e-5),
    )
    assert (world.victim.x, world.victim.y, world.victim.heading) == (50, 0, 0)
    world = imported("--start", "-60,-50,90")
    assert (world.start.x, world.start.y) == (-60, -50)


def test_a_part_of_a_map_about_a_place(imported: Imported) -> None:
    world = imported("--around", f"{LATITUDE},{LONGITUDE}", "--radius", 80)
    assert world.place.bounds == pytest.approx((-80, -80, 80, 80), abs=0.01)


@pytest.mark.long
@pytest.mark.rendering
def test_the_pictures_are_there_with_names_that_say_where(tmp_path: Path, smal: Smal) -> None:
    rendered = ("world", "render", "yard", "--views", 3, "--camera", "160x120", "--out")
    again = tmp_path / "again"
    assert smal(*rendered, tmp_path)[0] == smal(*rendered, again, "--workers", 2)[0] == 0
    world = load_world("yard")
    length = shapely.LineString(plan_route(world, (world.start.x, world.start.y))).length
    names = sorted(path.name for path in tmp_path.glob("view-*.png"))
    metres = [int(name.removesuffix("m.png").split("-")[2]) for name in names]
    assert [name.split("-")[1] for name in names] == ["00", "01", "02"]
    assert metres[0] == 0
    assert length - 6 < metres[2] < length
    assert all((tmp_path / name).read_bytes() == (again / name).read_bytes() for name in names)
    images = [cv2.imread(str(tmp_path / name)) for name in names]
    assert all(
        image is not None and image.shape == (120, 160, 3) and image.std() > 20 for image in images
    )
    drawn = cv2.imread(str(tmp_path / "map.png"))
    assert len(np.unique(drawn.reshape(-1, 3), axis=0)) > 100


def test_scan_becomes_a_world_of_two_files(tmp_path: Path, smal: Smal) -> None:
    laboratory().export(tmp_path / "lab.glb")
    chosen = ("--from", "1,1", "--to", "6.9,5", "--robot", "turtlebot")
    status, said, _ = smal(
        "world", "import", tmp_path / "lab.glb", "--out", tmp_path / "w.json", *chosen
    )
    assert status == 0
    rows = {line[:20].strip(): line[20:].strip() for line in said.splitlines()}
    assert rows["unit"].startswith("1 m")
    assert rows["holes in the floor"] == "0.0%"
    world = load_world(tmp_path / "w.json")
    assert (world.start.x, world.start.y, world.victim.x, world.victim.y) == (1, 1, 6.9, 5)
    route = plan_route(world, (1, 1))
    assert world.start.heading == pytest.approx(math.atan2(*(route[1] - route[0])[::-1]), abs=1e-3)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["lab.glb", "w.json", "w.npz"]


def test_options_of_scans_are_refused_for_maps(tmp_path: Path, smal: Smal) -> None:
    source = block_of_houses().write(tmp_path / "map.osm")
    status, _, said = smal("world", "import", source, "--out", tmp_path / "map.json", "--scale", 2)
    assert (status, said) == (2, "smal: --scale: unsupported for a map; leave it out\n")
    assert not (tmp_path / "map.json").exists()


def test_broken_scan_leaves_no_files(tmp_path: Path, smal: Smal) -> None:
    (tmp_path / "a.glb").write_bytes(b"glTF nonsense")
    status, _, said = smal("world", "import", tmp_path / "a.glb", "--out", tmp_path / "w.json")
    assert status == 1
    assert said.startswith(f"smal: {tmp_path / 'a.glb'}: cannot be read as GLB (")
    assert said.count("\n") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["a.glb"]

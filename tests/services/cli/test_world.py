"""``smal world import``: a map in, a world file and a summary out; every mistake is one line."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from services.cli.main import app
from services.kit.errors import JobError, UsageError
from services.simulator.world import World, load_world
from services.simulator.world.collision import obstacles_of
from services.simulator.world.route import plan_route, route_length_m
from services.simulator.world.terrain import Terrain
from tests.services.simulator.map_text import LATITUDE, LONGITUDE, MapText, block_of_houses

RUNNER = CliRunner()


def run(*arguments: object) -> str:
    result = RUNNER.invoke(app, ["world", "import", *map(str, arguments)], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return str(result.output)


def imported(folder: Path, *options: object, made: MapText | None = None) -> World:
    source = (made or block_of_houses()).write(folder / "map.osm")
    run(source, "--out", folder / "map.json", *options)
    return load_world(folder / "map.json")


def test_a_map_becomes_a_world_with_a_hidden_victim(tmp_path: Path) -> None:
    made = block_of_houses()
    made.way([(0, 0), (5, 5)], building="yes")
    source = made.write(tmp_path / "map.osm")
    said = run(source, "--out", tmp_path / "map.json")
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


def test_the_same_map_gives_the_same_file_and_another_seed_another_task(tmp_path: Path) -> None:
    imported(tmp_path)
    text = (tmp_path / "map.json").read_text()
    first = imported(tmp_path)
    assert (tmp_path / "map.json").read_text() == text
    others = {imported(tmp_path, "--seed", seed).victim for seed in (1, 2, 3)}
    assert others - {first.victim}


def test_start_and_victim_by_hand(tmp_path: Path) -> None:
    world = imported(tmp_path, "--start", "-60,-50,90", "--victim", "50,0")
    assert (world.start.x, world.start.y, world.start.heading) == (-60, -50, pytest.approx(math.pi / 2, abs=1e-5))
    assert (world.victim.x, world.victim.y, world.victim.heading) == (50, 0, 0)
    world = imported(tmp_path, "--start", "-60,-50,90")
    assert (world.start.x, world.start.y) == (-60, -50)


def test_a_part_of_a_map_about_a_place_or_about_the_task(tmp_path: Path) -> None:
    world = imported(tmp_path, "--around", f"{LATITUDE},{LONGITUDE}", "--radius", 80)
    assert world.place.bounds == pytest.approx((-80, -80, 80, 80), abs=0.01)
    whole = imported(tmp_path)
    part = imported(tmp_path, "--radius", 90)
    x_min, _, x_max, _ = part.place.bounds
    assert x_max - x_min == pytest.approx(180, abs=0.01)
    apart = [math.dist((w.start.x, w.start.y), (w.victim.x, w.victim.y)) for w in (whole, part)]
    assert apart[0] == pytest.approx(apart[1], abs=0.01)


@pytest.mark.parametrize(
    ("options", "error", "line"),
    [
        (("--start", "1,2"), UsageError, "--start '1,2': expected X,Y,HEADING_DEG"),
        (("--start", "nan,0,0"), UsageError, "--start 'nan,0,0'"),
        (("--victim", "9" * 400 + ",0"), UsageError, "larger than any world"),
        (("--around", "1,2"), UsageError, "needs --radius"),
        (("--around", "95,0", "--radius", "100"), UsageError, "latitude is from -85 to 85"),
        (("--around", "0,0", "--radius", "100"), JobError, "the map has no buildings"),
        (("--victim", "0,40"), JobError, "found no start|stands in an obstacle"),
        (("--start", "500,0,0"), JobError, "found no hidden place|outside the world"),
        (("--start=-60,-50,0", "--victim=0,40"), JobError, r"the victim at \(0.0, 40.0\) m stands in an obstacle"),
    ],
)
def test_a_wrong_wish_is_one_line(options: tuple[str, ...], error: type[Exception], line: str, tmp_path: Path) -> None:
    source = block_of_houses().write(tmp_path / "map.osm")
    with pytest.raises(error, match=line) as caught:
        run(source, "--out", tmp_path / "map.json", *options)
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "map.json").exists()


def test_files_that_cannot_be_are_bad_use(tmp_path: Path) -> None:
    source = block_of_houses().write(tmp_path / "map.osm")
    for arguments, line in (
        ((tmp_path / "none.osm", "--out", tmp_path / "a.json"), "no such file"),
        ((source, "--out", tmp_path / "a.txt"), r"ends in \.json"),
        ((source, "--out", tmp_path / "none" / "a.json"), "no folder"),
    ):
        with pytest.raises(UsageError, match=line):
            run(*arguments)


def test_the_attribution_is_in_the_file(tmp_path: Path) -> None:
    place = imported(tmp_path).place
    assert isinstance(place, Terrain)
    assert place.source is not None
    assert place.source.attribution == "© OpenStreetMap contributors, ODbL 1.0"
    assert (place.source.file, place.source.latitude_deg) == ("map.osm", pytest.approx(LATITUDE))

"""``smal world render``: a map, and views from the start to the victim."""

from __future__ import annotations

import math
from pathlib import Path

import cv2
import numpy as np
import pytest
import shapely
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from services.cli.world_render import aerial_view, render, scale_bar_m, viewpoints
from services.kit.errors import JobError, UsageError
from services.simulator.world import Pose, World, known_worlds, load_world
from services.simulator.world.collision import obstacles_of
from services.simulator.world.map_view import draw_map
from services.simulator.world.route import plan_route
from services.simulator.world.terrain import Building, Facade, Terrain


@pytest.mark.rendering
def test_the_pictures_are_there_with_names_that_say_where(tmp_path: Path) -> None:
    render("yard", tmp_path, views=3, camera="160x120")
    length = shapely.LineString(plan_route(load_world("yard"), _start("yard"))).length
    names = sorted(path.name for path in tmp_path.glob("view-*.png"))
    metres = [int(name.removesuffix("m.png").split("-")[2]) for name in names]
    assert [name.split("-")[1] for name in names] == ["00", "01", "02"]
    assert metres[0] == 0
    assert length - 6 < metres[2] < length
    images = [cv2.imread(str(tmp_path / name)) for name in names]
    assert all(image is not None and image.shape == (120, 160, 3) and image.std() > 20 for image in images)
    aerial = cv2.imread(str(tmp_path / "aerial.png"))
    assert aerial is not None
    assert aerial.std() > 20
    drawn = cv2.imread(str(tmp_path / "map.png"))
    assert drawn is not None
    assert len(np.unique(drawn.reshape(-1, 3), axis=0)) > 100


@pytest.mark.parametrize("name", known_worlds())
def test_views_begin_at_the_start_and_end_facing_the_victim(name: str) -> None:
    world = load_world(name)
    places = viewpoints(world, 7)
    assert places[0] == (0.0, world.start)
    assert all(obstacles_of(world.place).is_free(pose.x, pose.y) for _, pose in places)
    steps = np.diff([metres for metres, _ in places])
    np.testing.assert_allclose(steps, steps[0])
    last = places[-1][1]
    bearing = math.atan2(world.victim.y - last.y, world.victim.x - last.x)
    assert math.remainder(last.heading - bearing, math.tau) == pytest.approx(0, abs=1e-9)
    assert math.hypot(world.victim.x - last.x, world.victim.y - last.y) < world.scale.found_m


@pytest.mark.parametrize("name", ["campus", "yard"])
def test_from_the_air_one_looks_down_on_the_middle_of_the_route_from_outside_of_it(name: str) -> None:
    world = load_world(name)
    route = shapely.LineString(plan_route(world, (world.start.x, world.start.y)))
    eye, at = aerial_view(world)
    west, south, east, north = route.bounds
    assert (at[0], at[1], at[2]) == pytest.approx(((west + east) / 2, (south + north) / 2, 0.0))
    assert eye[1] < south
    assert eye[2] > max(building.height_m + building.roof_height_m for building in world.place.buildings)


def test_courtyards_are_open_on_the_map() -> None:
    court = shapely.box(10, 10, 20, 20)
    house = Building(shapely.box(0, 0, 30, 30).difference(court), 6.0, Facade("brick", None, 0), "flat")
    terrain = Terrain("court", (-10.0, -10.0, 40.0, 40.0), (house,), (), (), (), (), 0)
    figure = Figure(figsize=(4, 4), dpi=100)
    axes = figure.add_axes((0, 0, 1, 1))
    draw_map(World(terrain, Pose(-5.0, -5.0, 0.0), Pose(35.0, 35.0, 0.0)), axes)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    picture = np.asarray(canvas.buffer_rgba())
    to_pixel = axes.transData.transform
    inside, wall, outside = (
        picture[400 - round(y), round(x), :3] for x, y in map(to_pixel, [(15, 15), (5, 15), (35, 15)])
    )
    np.testing.assert_array_equal(inside, outside)
    assert np.abs(wall.astype(int) - outside).max() > 20


@pytest.mark.parametrize(
    ("across_m", "bar_m"), [(8.0, 1.0), (30.0, 5.0), (200.0, 20.0), (789.0, 100.0), (5000.0, 1000.0)]
)
def test_the_scale_is_a_round_number(across_m: float, bar_m: float) -> None:
    assert scale_bar_m(across_m) == bar_m


def test_a_world_that_does_not_exist_is_named(tmp_path: Path) -> None:
    with pytest.raises(JobError, match="atlantis"):
        render("atlantis", tmp_path, views=2, camera="160x120")


def test_a_size_that_is_none_is_named(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="--camera 'large'"):
        render("yard", tmp_path, views=2, camera="large")


def _start(name: str) -> tuple[float, float]:
    start = load_world(name).start
    return start.x, start.y

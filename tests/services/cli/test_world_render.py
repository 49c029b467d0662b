"""``smal world render``: a map, and views from the start to the victim."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import shapely

from services.cli.options import Camera
from services.cli.world import render
from services.simulator.world import load_world
from services.simulator.world.route import plan_route


@pytest.mark.rendering
def test_the_pictures_are_there_with_names_that_say_where(tmp_path: Path) -> None:
    render("yard", tmp_path, views=3, camera=Camera(160, 120))
    world = load_world("yard")
    length = shapely.LineString(plan_route(world, (world.start.x, world.start.y))).length
    names = sorted(path.name for path in tmp_path.glob("view-*.png"))
    metres = [int(name.removesuffix("m.png").split("-")[2]) for name in names]
    assert [name.split("-")[1] for name in names] == ["00", "01", "02"]
    assert metres[0] == 0
    assert length - 6 < metres[2] < length
    images = [cv2.imread(str(tmp_path / name)) for name in names]
    assert all(image is not None and image.shape == (120, 160, 3) and image.std() > 20 for image in images)
    drawn = cv2.imread(str(tmp_path / "map.png"))
    assert drawn is not None
    assert len(np.unique(drawn.reshape(-1, 3), axis=0)) > 100

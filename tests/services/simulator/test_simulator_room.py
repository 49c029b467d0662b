"""The room: starts and lanes of the world `indoor`, and files that cannot be used."""

import copy
import json
import math
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from shapely.geometry.base import BaseGeometry

from services.simulator.world.loading import WORLDS_FOLDER, world_of_text
from services.simulator.world.place import WorldError
from services.simulator.world.room import Room
from services.simulator.world.route import plan_route
from services.simulator.world.task import sample_start

CONTENT: dict[str, Any] = json.loads((WORLDS_FOLDER / "indoor.json").read_text())
INDOOR = world_of_text(json.dumps(CONTENT).encode(), Path("indoor.json"))
assert isinstance(INDOOR.place, Room)
ROOM = INDOOR.place
seeds = st.integers(0, 2**32 - 1)


def changed(field: str, value: object) -> dict[str, Any]:
    """Return the file's content with one field, named like furniture.3.width_m, of another value."""
    content = copy.deepcopy(CONTENT)
    *path, last = [int(part) if part.isdigit() else part for part in field.split(".")]
    place: Any = content
    for part in path:
        place = place[part]
    place[last] = value
    return content


def away_from_things(distance_m: float) -> BaseGeometry:
    """Return the floor at least so far from furniture and walls, independently of `Room`."""
    things = shapely.union_all([piece.footprint for piece in ROOM.furniture])
    return (
        shapely.box(*ROOM.bounds)
        .buffer(-distance_m)
        .difference(things.buffer(distance_m, quad_segs=32))
    )


@given(seed=seeds, purpose=st.sampled_from(["drive", "run", "recovery"]))
@settings(max_examples=40)
def test_starts_are_free_and_the_same_chance_gives_the_same(seed: int, purpose: Any) -> None:
    pose, again = (sample_start(INDOOR, np.random.default_rng(seed), purpose) for _ in range(2))
    assert pose == again
    assert away_from_things(ROOM.robot.radius_m + 0.05).covers(shapely.Point(pose.x, pose.y))
    if purpose == "recovery":
        route = shapely.LineString(plan_route(INDOOR, (INDOOR.start.x, INDOOR.start.y)))
        assert route.distance(shapely.Point(pose.x, pose.y)) <= ROOM.scale.aside_m + 1e-6
    else:
        assert (
            abs(math.remainder(pose.heading - INDOOR.start.heading, math.tau))
            <= math.radians(15) + 1e-9
        )


@given(x=st.floats(0.3, 7.7), y=st.floats(0.3, 5.7))
@settings(max_examples=60)
def test_lanes_reach_all_free_floor(x: float, y: float) -> None:
    victim = shapely.Point(INDOOR.victim.x, INDOOR.victim.y)
    reachable = [part for part in shapely.get_parts(away_from_things(0.29)) if part.covers(victim)]
    assume(any(part.covers(shapely.Point(x, y)) for part in reachable))
    route = plan_route(INDOOR, (x, y))
    np.testing.assert_allclose(route[[0, -1]], [(x, y), (INDOOR.victim.x, INDOOR.victim.y)])
    things = shapely.union_all([solid.shape for solid in ROOM.solids if solid.low_m < 0.36])
    # The route's simplification may cut 2 cm.
    assert all(shapely.LineString(leg).distance(things) > 0.24 for leg in pairwise(route))


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        ({}, r"Unable to extract tag using discriminator 'format'"),
        (changed("carpet", "red"), r"carpet: Unexpected keyword argument"),
        (changed("furniture.2.kind", "piano"), r"furniture\.2\.kind: 'piano' must be 'cabinet'"),
        (changed("furniture.0.width_m", math.nan), r"furniture\.0\.width_m: nan must be a finite number"),
        (changed("furniture.0.depth_m", 0.0), r"furniture\.0: depth_m: required for a partition"),
        (changed("furniture.0.x_m", 0.02), r"furniture\.0 \(partition\): .* at \(0\.02, 1\.6\) m, it extends beyond"),
        (changed("fittings.0.along_m", 5.9), r"fittings\.0: the door extends beyond the west wall"),
        (changed("start.x_m", 2.3), r"start: \(2\.3, 0\.82\) m is less than 0\.24 m from the furniture"),
        (changed("overhead.x_m", 9.0), r"overhead: at \(9, 3\) m outside the room"),
        (changed("victim", {"x_m": 1.0, "y_m": 3.0, "facing_deg": 0}), r'victim: visible from the start .*"hidden"'),
        (changed("furniture.9.width_m", 1.2) | {"furniture": [*CONTENT["furniture"], {
            "kind": "partition", "x_m": 7.3, "y_m": 4.0, "facing_deg": 90, "width_m": 1.4, "depth_m": 0.1,
            "height_m": 1.0}, {"kind": "partition", "x_m": 6.6, "y_m": 5.0, "facing_deg": 0, "width_m": 2.0,
            "depth_m": 0.1, "height_m": 1.0}]}, r"no route from \(0\.7, 0\.8\) m to the victim"),
    ],
)  # fmt: skip
def test_invalid_room_is_refused_in_one_line(content: dict[str, object], complaint: str) -> None:
    with pytest.raises(WorldError, match=complaint) as caught:
        world_of_text(json.dumps(content).encode(), Path("rooms/bad.json"))
    assert str(caught.value).startswith("rooms/bad.json: ")
    assert "\n" not in str(caught.value)

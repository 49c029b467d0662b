"""``load_world`` of a world's JSON file: terrains, and rooms."""

from __future__ import annotations

import random
from functools import cache

from services.simulator.world.importing import import_map
from services.simulator.world.loading import WORLDS_FOLDER, Wishes, load_world
from services.simulator.world.place import WorldError
from tests.fuzz import trees
from tests.fuzz.targets import check_line, scratch


@cache
def seeds() -> list[bytes]:
    _, text = import_map(WORLDS_FOLDER / "yard.osm", scratch.folder() / "seed.json", Wishes())
    return [text.encode(), *(path.read_bytes() for path in sorted(WORLDS_FOLDER.glob("*.json")))]


def run(data: bytes) -> bool:
    try:
        world = load_world(scratch.file_of(data, "x.json"))
    except WorldError as error:
        check_line(error)
        return False
    x_min, y_min, x_max, y_max = world.place.bounds
    for pose in (world.start, world.victim):
        assert x_min <= pose.x <= x_max
        assert y_min <= pose.y <= y_max
    return True


def mutate(data: bytes, rng: random.Random) -> bytes | None:
    return trees.changed_json(data, rng)

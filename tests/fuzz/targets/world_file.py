"""``load_world`` of a world's JSON file: terrains, and rooms."""

from __future__ import annotations

import random
from functools import cache

from services.simulator.world.loading import WORLDS_FOLDER, Wishes, import_map
from tests.fuzz import trees
from tests.fuzz.targets import scratch
from tests.fuzz.targets.world import loads


@cache
def seeds() -> list[bytes]:
    _, text = import_map(WORLDS_FOLDER / "yard.osm", scratch.folder() / "seed.json", Wishes())
    return [text.encode(), *(path.read_bytes() for path in sorted(WORLDS_FOLDER.glob("*.json")))]


def run(data: bytes) -> bool:
    return loads(data, "x.json")


def mutate(data: bytes, rng: random.Random) -> bytes | None:
    return trees.changed_json(data, rng)

"""The room that comes with the project, and how to change its file, for tests."""

from __future__ import annotations

import copy
import json
from pathlib import Path
from typing import Any

from services.simulator.world.loading import WORLDS_FOLDER, world_of_text
from services.simulator.world.place import World
from services.simulator.world.room import Room

PATH = WORLDS_FOLDER / "indoor.json"
CONTENT: dict[str, Any] = json.loads(PATH.read_text())


def read(content: object, path: Path = PATH) -> World:
    """Return the world that a file of that content and name describes."""
    return world_of_text(json.dumps(content).encode(), path)


def indoor() -> World:
    """Return the world `indoor`, read anew."""
    return read(CONTENT)


def room_of(world: World) -> Room:
    """Return a world's place, which is a room."""
    assert isinstance(world.place, Room)
    return world.place


def changed(field: str, value: object) -> dict[str, Any]:
    """Return the file's content with one field, named like furniture.3.width_m, of another value."""
    content = copy.deepcopy(CONTENT)
    *path, last = [int(part) if part.isdigit() else part for part in field.split(".")]
    place: Any = content
    for part in path:
        place = place[part]
    place[last] = value
    return content

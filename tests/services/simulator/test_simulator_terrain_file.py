"""World files: what is written is read again, what a person changes counts, what is hostile is one clear line."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from services.simulator.world import WorldError, load_world
from services.simulator.world.loading import WORLDS_FOLDER, Wishes, import_map
from services.simulator.world.terrain import terrain_text
from tests.services.simulator.map_text import block_of_houses

HERE = Path("here.json")


@pytest.mark.parametrize("name", ["campus", "terrace", "yard"])
def test_a_world_that_is_imported_is_the_same_in_its_file(name: str, tmp_path: Path) -> None:
    out = tmp_path / f"{name}.json"
    imported, text = import_map(WORLDS_FOLDER / f"{name}.osm", out, Wishes())
    out.write_text(text)
    assert terrain_text(load_world(out)) == terrain_text(imported) == text
    world = load_world(name)
    assert (imported.start.x, imported.victim.y) == pytest.approx((world.start.x, world.victim.y), abs=1e-3)


def world_file(change: Callable[[dict[str, Any]], object], folder: Path) -> Path:
    source = block_of_houses().write(folder / "map.osm")
    _, text = import_map(source, folder / "map.json", Wishes())
    content = json.loads(text)
    change(content)
    path = folder / "changed.json"
    path.write_text(json.dumps(content))
    return path


NAN = float("nan")


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (lambda c: c["victim"].update(x=0, y=40), r"the victim at \(0.0, 40.0\) m stands in an obstacle"),
        (lambda c: c["victim"].update(x=NAN), "victim.x: Input should be a finite number"),
        (lambda c: c.update(format="smal.terrain/2"), "tag 'smal.terrain/2' found using 'format' does not match"),
        (lambda c: c.update(buildings=[]), "the map has no buildings"),
        (lambda c: c["buildings"][1].update(outline=[[0, 0], [9, 9], [9, 0], [0, 9], [0, 0]]),
         "buildings.1: its outline crosses itself"),
        (lambda c: c.update(bounds=[1, 1, 0, 0]), "bounds: expected x_min, y_min, x_max, y_max"),
        (lambda c: c.update(bounds=[-9000, -9000, 9000, 9000]), "bounds: a world spans at most 10 km"),
        (lambda c: c["roads"][0].update(line=[[-4000, 0], [4000, 0]] * 100), "roads: .* km; a world has at most"),
        (lambda c: c.update(trees=[{}] * 60_000), "trees.0.x: Field required"),
        (lambda c: c.update(trees=[[]] * 1_600_000), "more than 1,500,000 of"),
    ],
)  # fmt: skip
def test_a_bad_world_file_gives_one_line(
    change: Callable[[dict[str, Any]], object], complaint: str, tmp_path: Path
) -> None:
    path = world_file(change, tmp_path)
    with pytest.raises(WorldError, match=complaint) as caught:
        load_world(path)
    assert str(path) in str(caught.value)
    assert str(caught.value).isprintable()


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        (b"", "1074 MB; a world has at most 34 MB"),
        (b"{", "Invalid JSON"),
        (b'{"format": ' + b"[" * 200_000, "recursion limit"),
        (b'{"format": ' + b"9" * 10_000 + b"}", "Invalid JSON: number out of range"),
        (b'{"format": "\\u001b[2J"}', r"tag '\?\[2J' found using 'format'"),
    ],
    ids=range(5),
)
def test_a_file_that_is_no_world_is_refused_quickly(content: bytes, complaint: str, tmp_path: Path) -> None:
    path = tmp_path / "bad.json"
    path.write_bytes(content)
    if not content:
        os.truncate(path, 1 << 30)
    began_s = time.process_time()
    with pytest.raises(WorldError, match=complaint) as caught:
        load_world(path)
    assert time.process_time() - began_s < 2
    assert str(caught.value).startswith(str(path))
    assert str(caught.value).isprintable()

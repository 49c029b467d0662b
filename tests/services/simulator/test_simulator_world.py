"""Worlds: ours say what they should, a real extract loads, and every broken file gives one clear line."""

from __future__ import annotations

import os
import time
from pathlib import Path

import numpy as np
import pytest

from services.simulator.world import WorldError, load_world
from services.simulator.world.collision import obstacles_of
from services.simulator.world.loading import WORLDS_FOLDER
from services.simulator.world.route import plan_route, route_length_m

BROWN = Path(__file__).parents[4] / "shared" / "data" / "osm" / "brown_university_campus.osm"
CAMPUS = (WORLDS_FOLDER / "campus.osm").read_text()
BILLION_LAUGHS = (
    '<!DOCTYPE osm [<!ENTITY a0 "ha">'
    + "".join(f'<!ENTITY a{k} "{f"&a{k - 1};" * 10}">' for k in range(1, 10))
    + ']><osm version="0.6"><node id="1" version="1" lat="1" lon="1"><tag k="name" v="&a9;"/></node></osm>'
)


@pytest.mark.skipif(not BROWN.exists(), reason=f"the real extract is not on this machine: {BROWN}")
def test_a_real_extract_gets_a_hidden_victim_by_rule() -> None:
    world = load_world(BROWN)
    assert len(world.place.buildings) > 350
    assert len(world.place.trees) == 32
    again = load_world(BROWN)
    assert (world.start, world.victim) == (again.start, again.victim)
    sight = np.array([[(world.start.x, world.start.y), (world.victim.x, world.victim.y)]])
    assert not obstacles_of(world.place).in_sight(sight)[0]
    assert 55 <= route_length_m(plan_route(world, (world.start.x, world.start.y))) <= 150


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        (BILLION_LAUGHS, "holds <!DOCTYPE; a map defines no document type and no entities"),
        ("<osm>" + " " * 2_000_000 + "<!ENTITY a 'b'>", "holds <!ENTITY"),
        (BILLION_LAUGHS.encode("utf-16").decode("latin-1"), "holds zero bytes"),
        (CAMPUS[: len(CAMPUS) // 2], "not a readable OpenStreetMap XML file"),
        ("<html><body/></html>", "not a readable OpenStreetMap XML file"),
        (CAMPUS.replace('"highway"', '"highroad"'), "the map has no roads"),
        (CAMPUS.replace('"building"', '"bidding"'), "the map has no buildings"),
        (CAMPUS.replace('v="victim"', 'v="start"'), "2 nodes are tagged smal:role=start"),
        (CAMPUS.replace('k="direction" v="0"', 'k="direction" v="nan"'), "direction=nan"),
    ],
)
def test_a_bad_file_gives_one_line_that_names_it(tmp_path: Path, content: str, complaint: str) -> None:
    path = tmp_path / "bad.osm"
    path.write_bytes(content.encode("latin-1" if "\0" in content else "utf-8"))
    began_s = time.process_time()
    with pytest.raises(WorldError, match=complaint) as caught:
        load_world(path)
    assert time.process_time() - began_s < 2
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_map_that_is_too_large_is_refused_before_and_while_it_is_read(tmp_path: Path) -> None:
    path = tmp_path / "large.osm"
    path.touch()
    os.truncate(path, 100_000_000)
    with pytest.raises(WorldError, match=r"large\.osm: 100 MB; a map has at most 67 MB"):
        load_world(path)
    way = '<way id="{}" version="1">' + '<nd ref="1"/>' * 2000 + "</way>"
    ways = "".join(way.format(k) for k in range(1, 510))
    path.write_text(f'<osm version="0.6"><node id="1" version="1" lat="1" lon="1"/>{ways}</osm>')
    with pytest.raises(WorldError, match="more than 1,000,000 points"):
        load_world(path)

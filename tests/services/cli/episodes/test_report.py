"""The page of results of ``smal run``."""

import sys
from pathlib import Path

import numpy as np
import pytest

from schemas.rpc import ResetRequest
from services.cli.episodes.client import EpisodeRecord
from services.cli.episodes.report import write_report
from services.cli.run import summarize
from services.kit.version import program_version
from services.simulator.world import load_world
from smal.files.stored import Stored
from tests import corridor


@pytest.fixture
def page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """Write the page of a run that ended 3 m beside the victim of the yard."""
    monkeypatch.setattr(sys, "argv", ["smal", "run", "--world", "yard"])
    victim = load_world("yard").victim
    record = EpisodeRecord(ResetRequest(seed=7), "yard", ticks=20, outcome="timeout")
    record.stamps_ns = {tick: tick * 500_000_000 for tick in (0, 10, 20)}  # as at 2 frames a second
    record.poses = {0: (0.0, 0.0), 20: (victim.x + 3.0, victim.y)}
    record.frames = {tick: np.zeros((24, 32, 3), dtype=np.uint8) for tick in (0, 10, 20)}
    model = Stored.load(corridor.save_model(tmp_path / "way.smal"))
    summary = summarize("yard", [record])
    return write_report(
        tmp_path, "yard", (tmp_path / "way.smal", model), [record], summary
    ).read_text()


def test_report_names_date_command_and_versions(page: str) -> None:
    footer = page.split("<footer>")[1].split("</footer>", maxsplit=1)[0]
    assert footer.startswith("20")
    assert f"smal run --world yard, SMAL {program_version()}, Python 3." in footer


def test_report_names_model_world_and_distance(page: str) -> None:
    assert "way.smal, checksum " in page
    assert "SMAL: yard, 1 run" in page
    assert "<td>out of time</td><td>7</td><td>3.0</td><td>21</td><td>10</td>" in page


def test_report_plays_the_pictures_of_a_run(page: str) -> None:
    film = page.split('<figure class="player">')[1].split("</figure>", maxsplit=1)[0]
    assert film.count("data:image/jpeg") == 3
    assert "5 s, frame 10" in film
    assert film.count('class="wide shown"') == 1
    assert 'max="2"' in film

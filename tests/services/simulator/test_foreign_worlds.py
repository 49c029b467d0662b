"""The file of a user becomes a world within bounds, and can be cancelled."""

import shutil
from pathlib import Path

import pytest

from services.kit.going_on import asking
from services.simulator.world import WorldError, load_foreign_world, load_world, loading
from services.simulator.world.loading import WORLDS_FOLDER
from smal.files import confined


@pytest.fixture
def town(tmp_path: Path) -> Path:
    return Path(shutil.copy(WORLDS_FOLDER / "yard.osm", tmp_path / "town.osm"))


def test_world_is_the_same_when_its_file_is_foreign(town: Path) -> None:
    found = load_foreign_world(town)
    sound = load_world(town)
    assert (found.name, found.start, found.victim) == (sound.name, sound.start, sound.victim)


@pytest.fixture
def endless(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make the loading of any world take for ever."""
    bounded = loading.bounded
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[3]))
    monkeypatch.setattr(
        loading, "bounded", lambda _function, *more: bounded("tests.confined_work:loop", *more)
    )


@pytest.mark.usefixtures("endless")
def test_world_is_refused_when_it_takes_too_much_time(
    town: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(confined, "LEAST_S", 0.1)
    monkeypatch.setattr(confined, "S_A_MEGABYTE", 0.0)
    monkeypatch.setattr(confined, "_WAITING", 1e4)  # On a loaded machine the clock runs far ahead.
    with pytest.raises(
        WorldError, match=r"\A[^\n]*town.osm: reading it takes more than 0.1 s of processor time"
    ) as why:
        load_foreign_world(town)
    assert "SMAL_LIMITS=2 doubles the limit" in str(why.value)


def test_world_is_refused_in_one_line_when_it_is_of_no_use(town: Path) -> None:
    town.write_text("<osm>")
    with pytest.raises(
        WorldError, match=r"\A[^\n]*town.osm: not a readable OpenStreetMap file[^\n]*\Z"
    ):
        load_foreign_world(town)


@pytest.mark.usefixtures("endless")
def test_loading_ends_when_it_is_cancelled(town: Path) -> None:
    def cancel() -> None:
        raise InterruptedError("cancelled")

    with asking(cancel), pytest.raises(InterruptedError, match="cancelled"):
        load_foreign_world(town)


def test_world_starts_no_process_when_it_is_ours(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(loading, "bounded", None)
    assert load_foreign_world("yard").name == "yard"

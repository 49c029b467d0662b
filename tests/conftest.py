"""Fixtures and settings of all tests."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from hypothesis import settings

from services.simulator.world import Pose
from services.simulator.world.loading import WORLDS_FOLDER, RoleWishes, Wishes, import_map
from tests.chromium import CHROMIUM, FLAGS, NO_CHROMIUM
from tests.command import run_smal
from tests.services.waiting import Lost, stalls
from tests.sharing import FIRST, Sharing, made_once

if TYPE_CHECKING:
    from playwright.sync_api import Browser
    from xdist.remote import Producer

# Numpy reads it when it is loaded. A second thread does nothing for products as small as ours, and where another
# process wants the core it waits in a loop: learning then takes four times the processor time.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# Tests start some hundred processes: each would compile all that it imports again.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False
# The same examples in every run: what fails, fails for whoever changed something. HYPOTHESIS_PROFILE=default explores.
# None has a deadline: a busy machine is slow, and that proves nothing.
settings.register_profile("default", deadline=None)
settings.register_profile("repeatable", derandomize=True, deadline=None)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "repeatable"))


def pytest_configure() -> None:
    """Have the programs that tests start take signals as usual, also under nohup or in the background.

    What this process ignores its children ignore too; what it handles they take by default.
    """
    for number in (signal.SIGHUP, signal.SIGINT, signal.SIGQUIT):
        if signal.getsignal(number) is signal.SIG_IGN:
            signal.signal(number, lambda *_: None)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with the longest folders, so that no process ends alone with them."""
    items.sort(
        key=lambda item: next(
            (k for k, one in enumerate(FIRST) if item.nodeid.startswith(one)), len(FIRST)
        )
    )


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Producer) -> Sharing:
    """Share the tests by folder and file, regardless of ``--dist``."""
    config.option.loadscopereorder = False
    return Sharing(config, log)


@pytest.fixture(scope="session")
def near(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Make a world where a drive takes some seconds: the yard's way with both corners, without the long stretches."""

    def make(folder: Path) -> None:
        _, text = import_map(
            WORLDS_FOLDER / "yard.osm",
            folder / "near.json",
            Wishes(RoleWishes(Pose(-8.0, 1.0, 0.0))),
        )
        (folder / "near.json").write_text(text)

    return made_once(tmp_path_factory, "near", make) / "near.json"


@pytest.fixture(scope="session")
def taught(near: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Record one drive in that world, and learn a model from it; return their folder."""

    def make(folder: Path) -> None:
        drives = folder / "drives"
        for arguments in (
            ("demonstrate", "--world", near, "--seed", 1, "--camera", "160x120", "--out", drives),
            ("learn", drives, "--out", folder / "model.smal", "--json", folder / "learned.json"),
        ):
            done = run_smal(*arguments)
            assert done.returncode == 0, done.stderr

    return made_once(tmp_path_factory, "taught", make)


@pytest.fixture(scope="session")
def taught_paper(taught: Path) -> Path:
    """Learn the paper's model from the same drive, beside the other; return its file."""
    model = taught / "paper.smal"
    if not model.exists():
        done = run_smal("paper", "learn", taught / "drives", "--out", model)
        assert done.returncode == 0, done.stderr
    return model


@pytest.fixture
def lost_s() -> Iterator[Lost]:
    """Give the time that a busy machine added since a moment; see `stalls`."""
    with stalls() as lost_s:
        yield lost_s


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    """Start Debian's Chromium, which deploy/setup.sh --tests installs, for tests of pages."""
    from playwright.sync_api import sync_playwright  # noqa: PLC0415 - only tests of pages need it

    assert CHROMIUM is not None, NO_CHROMIUM
    with sync_playwright() as play:
        yield play.chromium.launch(executable_path=CHROMIUM, args=FLAGS)

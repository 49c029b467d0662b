"""One stack with its page."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from services.cli.stack import Stack, StackPlan, flags, free_endpoint
from services.kit.bus import Bus
from services.table import stack_services
from tests.system.console.console_site import Site, opened

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page


@pytest.fixture(scope="package")
def site(near: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Site]:
    """Start a stack in the world where a drive takes some seconds."""
    root = tmp_path_factory.mktemp("root")
    endpoint = free_endpoint()
    address = free_endpoint().removeprefix("tcp/")
    (root / "worlds").mkdir()
    world = shutil.copy(near, root / "worlds")
    below = flags(root=root)
    own = {
        "robot": flags(world=world, camera_width=160, camera_height=120) + below,
        **dict.fromkeys(("recognition", "policy", "recorder"), below),
        "console": flags(console=address) + below,
    }
    plan = StackPlan(stack_services(), "rescuebot", endpoint, own, logs=root / "logs")
    with Stack(plan) as stack, closing(Bus("rescuebot", endpoint)) as bus:
        yield Site(address, stack, bus, root)


@pytest.fixture
def page(browser: Browser, site: Site) -> Iterator[Page]:
    """Open the page."""
    with opened(browser, site) as page:
        yield page

"""A stack with its page, for one module of tests."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from typing import TYPE_CHECKING

import pytest

from services.cli.stack import Stack, StackPlan, flags, free_endpoint
from services.kit.bus import Bus
from services.simulator.world import Pose
from services.simulator.world.loading import WORLDS_FOLDER, Wishes, import_map
from services.table import stack_services
from tests.system.console_site import Site, opened

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Site]:
    """Start a stack on the world ``yard``."""
    root, endpoint = tmp_path_factory.mktemp("root"), free_endpoint()
    address = free_endpoint().removeprefix("tcp/")
    # Where a drive takes some seconds: the way in the yard with both corners, without the long stretches.
    (root / "worlds").mkdir()
    _, text = import_map(WORLDS_FOLDER / "yard.osm", root / "worlds" / "near.json", Wishes(Pose(-8.0, 1.0, 0.0)))
    (root / "worlds" / "near.json").write_text(text)
    below = flags(root=root)
    own = {
        "robot": flags(world="yard", camera_width=160, camera_height=120) + below,
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

"""A console, the robot that it drives, and the pages that are open."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from services.console.config import ConsoleSettings
from services.console.newest_content import Board
from services.console.service import ConsoleService
from services.console.web import WebServer
from services.kit.node import Node
from services.kit.settings import ServiceSettings
from services.recorder.service import RecorderService
from tests.services.conftest import RunNode
from tests.services.console.page import Page
from tests.services.robot.wheels import Robot, run_robot


@dataclass(frozen=True)
class Console:
    """What runs in the process of the test."""

    service: ConsoleService
    board: Board
    server: WebServer
    root: Path


@pytest.fixture
def robot(request: pytest.FixtureRequest, settings: ServiceSettings, run_node: RunNode) -> Robot:
    """Give a robot on a line that moves only while an operator is there, unless the test says otherwise."""
    return run_robot(settings, run_node, attended=getattr(request, "param", True))


@pytest.fixture
def recorder(settings: ServiceSettings, run_node: RunNode, tmp_path: Path) -> RecorderService:
    """Give a recorder."""
    node = Node("recorder", settings)
    recorder = RecorderService(node, tmp_path)
    run_node(node)
    return recorder


@pytest.fixture
def console(settings: ServiceSettings, run_node: RunNode, tmp_path: Path) -> Iterator[Console]:
    """Give a console whose page is on a port of its own."""
    own = ConsoleSettings(robot=settings.robot, router=settings.router, root=tmp_path, console="127.0.0.1:0")
    node = Node("console", own)
    board = Board()
    service = ConsoleService(node, board, own.root)
    server = WebServer(service, board, own)
    service.feed.start()
    run_node(node)
    yield Console(service, board, server, own.root)
    server.close()
    service.close()


@pytest.fixture
def open_page(console: Console) -> Iterator[Callable[[], Page]]:
    """Open pages, and close them at the end."""
    pages: list[Page] = []

    def open_one() -> Page:
        pages.append(Page(console.server))
        return pages[-1]

    yield open_one
    for page in pages:
        page.close()

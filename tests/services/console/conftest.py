"""A console, the robot that it drives, and the pages that are open."""

from collections.abc import Callable, Iterator
from concurrent.futures import Future
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import IO

import pytest

from services.console.config import ConsoleSettings
from services.console.library import Library
from services.console.newest_content import Board
from services.console.server import WebServer
from services.console.service import ConsoleService
from services.kit.node import Node
from services.kit.settings import ServiceSettings
from services.recorder.service import RecorderService
from tests.services.conftest import RunNode
from tests.services.console.page import Page
from tests.services.robot.wheels import Robot, run_robot
from tests.services.waiting import eventually


class Nobody:
    """Replace the console's service: record the requests, and do nothing."""

    live = SimpleNamespace(learned=None)

    def __init__(self, root: Path) -> None:
        self.library = Library(root)
        self.asked: list[object] = []
        self.held: object = None
        self.stops = 0
        self.maps: list[tuple[str, bytes]] = []

    def do(self, what: Callable[..., None], *arguments: object) -> Future[None]:
        done: Future[None] = Future()
        what(*arguments)
        done.set_result(None)
        return done

    def hold(self, held: object, sent_s: float) -> None:
        self.held = held

    def let_go(self) -> None: ...

    def leave(self) -> None: ...

    def stop(self) -> None:
        self.stops += 1

    def ask(self, ask: object, until_s: float) -> None:
        self.asked.append(ask)

    def make_world(self, name: str, upload: IO[bytes]) -> None:
        self.maps.append((name, Path(f"/proc/self/fd/{upload.fileno()}").read_bytes()))


@pytest.fixture
def nobody(tmp_path: Path) -> Nobody:
    return Nobody(tmp_path)


@pytest.fixture
def page(nobody: Nobody, tmp_path: Path) -> Iterator[Page]:
    """Give a page that is open to this machine, without a bus."""
    server = WebServer(nobody, Board(), ConsoleSettings(root=tmp_path, console="127.0.0.1:0"))
    page = Page(server)
    yield page
    page.close()
    server.close()


@pytest.fixture
def seated(page: Page) -> Page:
    """Give a page that drives."""
    page.take()
    eventually(lambda: page.word)
    return page


@dataclass(frozen=True)
class Console:
    """The console that runs in the process of the test."""

    service: ConsoleService
    board: Board
    server: WebServer
    root: Path


@pytest.fixture
def robot(request: pytest.FixtureRequest, settings: ServiceSettings, run_node: RunNode) -> Robot:
    """Give an attended robot on a line, or an unattended one by parameter."""
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
    own = ConsoleSettings(
        robot=settings.robot, router=settings.router, root=tmp_path, console="127.0.0.1:0"
    )
    node = Node("console", own)
    board = Board()
    service = ConsoleService(node, board, own.root)
    server = WebServer(service, board, own)
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

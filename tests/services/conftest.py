"""A router, nodes in threads, and a client: what the tests of every service need.

Every router is a real one, of Zenoh, for one test alone. The functions that wait are in ``waiting``.
"""

import socket
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from services.kit.bus import Bus, Router
from services.kit.node import Node
from services.kit.settings import ServiceSettings
from tests import corridor

RunNode = Callable[[Node], Node]


def pytest_itemcollected(item: pytest.Item) -> None:
    """Mark what needs a router."""
    if isinstance(item, pytest.Function) and "free_endpoint" in item.fixturenames:
        item.add_marker(pytest.mark.zenoh)


@pytest.fixture
def free_endpoint() -> str:
    """Address on this machine where nobody listens."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


@pytest.fixture
def router_endpoint(free_endpoint: str) -> Iterator[str]:
    """Address of a router of this test's own."""
    router = Router(free_endpoint)
    yield free_endpoint
    router.close()


@pytest.fixture
def settings(router_endpoint: str) -> ServiceSettings:
    """Give the settings of a node on that router."""
    return ServiceSettings(robot="rescuebot", router=router_endpoint)


@pytest.fixture
def client(router_endpoint: str) -> Iterator[Bus]:
    """Connect a client to publish and call with."""
    bus = Bus("rescuebot", router_endpoint)
    bus.wait_connected(100.0)
    yield bus
    bus.close()


@pytest.fixture
def run_node(router_endpoint: str) -> Iterator[RunNode]:
    """Spin nodes in threads until the test is over; each must then stop."""
    running: list[tuple[Node, threading.Thread]] = []

    def run(node: Node) -> Node:
        thread = threading.Thread(target=node.spin, name=node.name, daemon=True)
        thread.start()
        running.append((node, thread))
        return node

    yield run
    for node, thread in running:
        node.stop()
        thread.join(100.0)
        assert not thread.is_alive(), f"{node.name} did not stop"
        node.close()


@pytest.fixture(scope="session")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Save a model with a map of views of the corridor; return its file."""
    return corridor.save_model(tmp_path_factory.mktemp("model") / "mapped.smal")

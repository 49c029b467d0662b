"""A router, nodes in threads, and a client: what the tests of every service need.

Each test that needs a router runs twice: in the memory of this process, and over Zenoh with a real router. What is
marked ``zenoh`` runs over Zenoh alone: it needs processes, links or outages. The functions that wait are in
``waiting``.
"""

from __future__ import annotations

import socket
import threading
from collections.abc import Callable, Iterator

import pytest

from services.kit.bus import Bus, MemoryRouter, Router
from services.kit.node import Node
from services.kit.settings import ServiceSettings

RunNode = Callable[[Node], Node]


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Choose the routers of a test."""
    if "router_endpoint" in metafunc.fixturenames:
        zenoh = pytest.param("zenoh", marks=pytest.mark.zenoh)
        alone = metafunc.definition.get_closest_marker("zenoh") is not None
        metafunc.parametrize("router_endpoint", [zenoh] if alone else ["memory", zenoh], indirect=True)


def pytest_itemcollected(item: pytest.Item) -> None:
    """Mark what makes routers of its own."""
    if isinstance(item, pytest.Function) and "free_endpoint" in item.fixturenames:
        item.add_marker(pytest.mark.zenoh)


@pytest.fixture
def free_endpoint() -> str:
    """Address on this machine where nobody listens."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


@pytest.fixture
def router_endpoint(request: pytest.FixtureRequest) -> Iterator[str]:
    """Address of a router of this test's own."""
    in_memory = request.param == "memory"
    endpoint: str = "memory/test" if in_memory else request.getfixturevalue("free_endpoint")
    router = MemoryRouter(endpoint) if in_memory else Router(endpoint)
    yield endpoint
    router.close()


@pytest.fixture
def settings(router_endpoint: str) -> ServiceSettings:
    """Give the settings of a node on that router."""
    return ServiceSettings(robot="rescuebot", router=router_endpoint)


@pytest.fixture
def client(router_endpoint: str) -> Iterator[Bus]:
    """Connect a client to publish and call with."""
    bus = Bus("rescuebot", router_endpoint)
    bus.wait_connected(5.0)
    yield bus
    bus.close()


@pytest.fixture
def run_node(router_endpoint: str) -> Iterator[RunNode]:
    """Spin nodes in threads until the test is over; each must then stop within five seconds."""
    running: list[tuple[Node, threading.Thread]] = []

    def run(node: Node) -> Node:
        thread = threading.Thread(target=node.spin, name=node.name, daemon=True)
        thread.start()
        running.append((node, thread))
        return node

    yield run
    for node, thread in running:
        node.stop()
        thread.join(5.0)
        assert not thread.is_alive(), f"{node.name} did not stop"
        node.close()

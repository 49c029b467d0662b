"""A node, and its status."""

from collections.abc import Iterator

import pytest

from schemas.rpc import Status
from services.kit.bus import Bus
from services.kit.node import Node
from services.kit.settings import ServiceSettings
from tests.services.waiting import status_of


@pytest.fixture
def node(settings: ServiceSettings) -> Iterator[Node]:
    with Node("sample", settings) as node:
        yield node


def status(client: Bus) -> Status:
    return status_of(client, "sample")

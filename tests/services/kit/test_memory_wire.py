"""What only the wire in memory has: its addresses, and Zenoh's key expressions without Zenoh."""

from __future__ import annotations

import threading
from collections.abc import Iterator

import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st

from schemas import topics
from schemas.rpc import Nothing
from schemas.state import State
from services.kit.bus import Bus, BusError, MemoryRouter
from services.kit.memory_wire import key_expression, matches
from tests.schemas.messages import EXAMPLES

PARTS = st.lists(st.sampled_from(["*", "**", "a", "b", "a*", ""]), min_size=1, max_size=5)


@pytest.fixture
def router() -> Iterator[MemoryRouter]:
    router = MemoryRouter("memory/alone")
    yield router
    router.close()


def test_an_address_that_this_process_has_not_opened_is_one_line() -> None:
    with pytest.raises(BusError, match=r"^no router at 'memory/none': .*; expected tcp/<host>:<port>$"):
        Bus("rescuebot", "memory/none")


@pytest.mark.parametrize("endpoint", ["memory/alone", "tcp/127.0.0.1:7447", "nonsense"])
@pytest.mark.usefixtures("router")
def test_an_address_that_cannot_be_opened(endpoint: str) -> None:
    with pytest.raises(BusError, match=r"^cannot listen on .*: expected memory/NAME that is not in use$"):
        MemoryRouter(endpoint)


def test_a_router_that_is_closed_is_gone(router: MemoryRouter) -> None:
    bus, heard = Bus("rescuebot", router.endpoint), threading.Event()
    bus.subscribe(topics.STATE, lambda *_: heard.set())
    assert bus.connected()
    router.close()
    assert not bus.connected()
    bus.publish(EXAMPLES[State])
    again = MemoryRouter(router.endpoint)
    assert not bus.connected(), "it is another one"
    assert not heard.wait(0.05)
    bus.close()
    again.close()


def test_a_closed_bus_is_of_no_use(router: MemoryRouter) -> None:
    bus = Bus("rescuebot", router.endpoint)
    bus.close()
    with pytest.raises(BusError, match=r"^the bus is closed$"):
        bus.publish(EXAMPLES[State])


def test_a_handler_that_calls_on_its_own_bus_is_told(router: MemoryRouter) -> None:
    """Over Zenoh it would wait for itself until its time is over."""
    bus, told = Bus("rescuebot", router.endpoint), threading.Event()

    def call(*_sample: object) -> None:
        with pytest.raises(BusError, match="it would wait for itself"):
            bus.call("sim", "end", Nothing(), Nothing)
        told.set()

    bus.subscribe(topics.STATE, call)
    bus.publish(EXAMPLES[State])
    assert told.wait(10.0)
    bus.close()


@given(PARTS, st.lists(st.sampled_from("ab"), min_size=1, max_size=6))
def test_key_expressions_mean_what_they_mean_to_zenoh(parts: list[str], key: list[str]) -> None:
    try:
        expected = zenoh.KeyExpr("/".join(parts)).intersects(zenoh.KeyExpr("/".join(key)))
    except zenoh.ZError:
        with pytest.raises(BusError, match="invalid key expression"):
            key_expression("/".join(parts))
    else:
        assert matches(key_expression("/".join(parts)), tuple(key)) == expected

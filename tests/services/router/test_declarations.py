"""The bound on declarations: its rule, and sessions that flood a router."""

from contextlib import closing

import pytest
import zenoh

from services.kit.bus import Bus
from services.router.declarations import (
    BURST,
    BURST_A_ROBOT,
    GROUP_BURST,
    GROUP_BURST_A_ROBOT,
    GROUP_RATE_HZ,
    RATE_HZ,
    Declarations,
)
from tests.services.chain import process
from tests.services.secured import open_session
from tests.services.waiting import eventually

MOST = BURST + BURST_A_ROBOT
_BEGIN = (
    b"2026-11-27T16:00:36.226199Z DEBUG  rx-1 ThreadId(08) demux{zid=38904369 src=south:0:%s/%s}: "
)
_FACE = b"zenoh::net::routing::dispatcher::face: expr=WireExpr { scope: 1 } expr.mapped=%s\n"
PATIENT: dict[str, object] = {"connect/timeout_ms": 10_000}


def entry(source: bytes = b"client", face: bytes = b"6715b33e:1", key: bytes = b"x/y") -> bytes:
    """Return an entry of Zenoh's log about a declaration."""
    return _BEGIN % (source, face) + _FACE % key


def counted(*entries: tuple[bytes, float], linked: bool = False) -> list[str]:
    """Count entries; return the sessions that are disconnected."""
    ended: list[str] = []
    declarations = Declarations(1, linked=linked, disconnect=ended.append)
    for line, now_s in entries:
        declarations.count(line, now_s)
    return ended


def test_a_session_is_disconnected_when_it_declares_too_much() -> None:
    assert counted(*[(entry(), 0.0)] * MOST) == []
    assert counted(*[(entry(), 0.0)] * (MOST + 1)) == ["6715b33e"]


def test_sessions_are_counted_apart() -> None:
    other = entry(face=b"6715b33e:2")
    assert counted(*[(entry(), 0.0), (other, 0.0)] * MOST) == []


def test_declarations_are_bounded_when_they_are_taken_back() -> None:
    pair = entry(), entry(key=b"None")
    assert (
        counted(*[(line, n / RATE_HZ) for n in range(2 * MOST) for line in pair[n % 2 : n % 2 + 1]])
        == []
    )
    assert counted(*[(line, 0.0) for line in pair * MOST]) == ["6715b33e"]


def test_keys_of_a_session_are_bounded_however_slow() -> None:
    keys = [(entry(key=b"x/%d" % n), float(n)) for n in range(MOST + 1)]
    assert counted(*keys[:-1]) == []
    assert counted(*keys) == ["6715b33e"]


def test_a_session_may_ask_for_the_same_tokens_for_ever() -> None:
    query = entry(key=b"smal/rescuebot/@group/tracker/**")
    assert counted(*[(query, n / 5.0) for n in range(10 * MOST)]) == []


def register(key: bytes) -> bytes:
    """Return an entry of Zenoh's log about a key that was not known."""
    return (
        _BEGIN % (b"client", b"6715b33e:1")
        + b"zenoh::net::routing::dispatcher::resource: Register resource "
        + key
    )


def test_keys_of_groups_are_bounded_more_strictly() -> None:
    group = register(b"smal/rescuebot/@group/recognition/0123abcd-1")
    most = GROUP_BURST + GROUP_BURST_A_ROBOT
    assert counted(*[(group, 0.0)] * most) == []
    assert counted(*[(group, 0.0)] * (most + 1)) == ["6715b33e"]
    assert counted(*[(group, n / GROUP_RATE_HZ) for n in range(10 * most)]) == []
    assert counted(*[(register(b"smal/rescuebot/camera/jpeg"), 0.0)] * MOST) == []


def test_a_key_with_line_breaks_is_counted() -> None:
    broken = _BEGIN % (b"client", b"6715b33e:1") + b"declare_token{expr=x\ny}: " + _FACE % b"x"
    assert counted(*[(broken, 0.0)] * (MOST + 1)) == ["6715b33e"]


@pytest.mark.parametrize("linked", [False, True])
def test_a_linked_router_is_trusted(linked: bool) -> None:
    assert counted(*[(entry(b"router"), 0.0)] * (MOST + 1), linked=linked) == (
        [] if linked else ["6715b33e"]
    )


def test_a_key_cannot_pass_for_an_entry_of_another_session() -> None:
    forged = entry(key=b"x\n" + entry(face=b"deadbeef:2"))
    assert set(counted(*[(forged, 0.0)] * (MOST + 1))) == {"6715b33e"}


@pytest.mark.parametrize("kind", ["token", "subscriber", "queryable"])
def test_a_flood_of_declarations_ends_and_others_stay(kind: str, free_endpoint: str) -> None:
    with process("router", free_endpoint):
        bystander = Bus("rescuebot", free_endpoint, patience_s=100.0)
        with closing(bystander), closing(open_session(free_endpoint, None, PATIENT)) as flooder:
            before = bystander.sessions.copy()
            events: list[zenoh.TransportEvent] = []
            callback = zenoh.handlers.Callback(events.append, indirect=False)
            listener = flooder.info.declare_transport_events_listener(callback)
            declared: list[object] = []

            def disconnected() -> bool:
                key = f"smal/rescuebot/@group/features/{len(declared):08x}-1"
                ring: zenoh.handlers.RingChannel[zenoh.Sample] = zenoh.handlers.RingChannel(1)
                if kind == "token":
                    declared.append(flooder.liveliness().declare_token(key))
                elif kind == "subscriber":
                    declared.append(flooder.declare_subscriber(key, ring))
                else:
                    declared.append(flooder.declare_queryable(key, zenoh.handlers.RingChannel(1)))
                return any(event.kind == zenoh.SampleKind.DELETE for event in events)

            eventually(disconnected)
            listener.undeclare()
            assert bystander.connected()
            assert bystander.sessions == before

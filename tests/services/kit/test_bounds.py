"""The bound on calls of one session: a router drops a flood of calls, and nothing of other sessions."""

import time
from contextlib import closing
from typing import Any

import zenoh

from schemas.topics import COMMANDS, rpc_key
from services.kit.zenoh_session import MOST_CALLS_HZ, settings_of
from services.table import roles
from tests.services.secured import open_session
from tests.services.waiting import eventually

STOP = COMMANDS["emergency_stop"].key("rescuebot")
STATUS = rpc_key("rescuebot", "robot", "status")
FLOOD = 40_000  # More than a router lets through in the time that it takes to ask them.


def test_each_call_of_a_role_is_bounded() -> None:
    items: Any = settings_of("router", "tcp/127.0.0.1:1", None)["downsampling"]
    (item,) = items
    assert item["messages"] == ["query"]
    calls = {rpc_key("*", *name.split("/", 1)) for role in roles().values() for name in role.calls}
    assert calls <= {rule["key_expr"] for rule in item["rules"]}


def test_flood_of_calls_is_dropped_while_stops_pass(
    router_endpoint: str,
) -> None:
    asked = [0]
    stops = [0]

    def answer(query: zenoh.Query) -> None:
        with query:
            asked[0] += 1
            query.reply(STATUS, b"{}")

    def note(_sample: zenoh.Sample) -> None:
        stops[0] += 1

    with (
        closing(open_session(router_endpoint, None)) as robot,
        closing(open_session(router_endpoint, None)) as flooder,
        closing(open_session(router_endpoint, None)) as other,
    ):
        served = robot.declare_queryable(STATUS, zenoh.handlers.Callback(answer, indirect=False))
        heard = robot.declare_subscriber(STOP, zenoh.handlers.Callback(note, indirect=False))
        eventually(lambda: list(other.get(STATUS, timeout=100.0)))
        eventually(lambda: (other.put(STOP, b"first"), stops[0])[1])
        # What was put until then has come: nothing of one session overtakes.
        list(other.get(STATUS, timeout=100.0))
        before = stops[0]
        since_s = time.monotonic()
        for number in range(FLOOD):
            flooder.get(STATUS, zenoh.handlers.RingChannel(1), timeout=100.0)
            if number % (FLOOD // 10) == 0:
                flooder.put(STOP, b"of the flooder")
                other.put(STOP, b"of another one")
                assert list(other.get(STATUS, timeout=100.0)), "who asks one by one is answered"
        asked_s = time.monotonic() - since_s
        eventually(lambda: stops[0] == before + 20)
        served.undeclare()
        heard.undeclare()
    assert 0 < asked[0] <= MOST_CALLS_HZ * (asked_s + 1.0) + 100

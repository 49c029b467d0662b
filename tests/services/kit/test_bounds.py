"""What a router lets one session send in a second: a flood is dropped at the door, of others nothing, and no stop."""

from __future__ import annotations

from collections import Counter
from contextlib import ExitStack, closing
from typing import Any

import pytest
import zenoh

from schemas.topics import COMMANDS, HEARTBEAT, rpc_key
from services.kit.zenoh_settings import MOST_PUTS_HZ, settings_of
from services.table import roles
from tests.services.secured import open_session
from tests.services.waiting import eventually

STOP, POLICY = COMMANDS["emergency_stop"], COMMANDS["policy"]
#: More than a router lets through in the time that it takes to send them.
FLOOD = 20_000


def bounded() -> dict[str, set[str]]:
    items: Any = settings_of("router", "tcp/127.0.0.1:1", None)["downsampling"]
    return {item["id"]: {rule["key_expr"] for rule in item["rules"]} for item in items}


def test_what_answers_one_by_one_is_bounded_and_no_stop_nor_what_comes_in_bursts() -> None:
    assert bounded()["puts"] == {topic.key("*") for topic in (POLICY, COMMANDS["expert"], HEARTBEAT)}


def test_every_call_that_a_role_may_make_is_bounded() -> None:
    calls = {rpc_key("*", *name.split("/", 1)) for role in roles().values() for name in role.calls}
    assert calls <= bounded()["calls"]


@pytest.mark.zenoh
def test_a_flood_is_dropped_at_the_door_and_nothing_of_others_nor_any_stop(router_endpoint: str) -> None:
    heard: Counter[tuple[str, bytes]] = Counter()
    policy, stop = POLICY.key("rescuebot"), STOP.key("rescuebot")
    with ExitStack() as stack:
        witness, flooder, other = (stack.enter_context(closing(open_session(router_endpoint, None))) for _ in range(3))

        def note(sample: zenoh.Sample) -> None:
            heard[str(sample.key_expr), sample.payload.to_bytes()] += 1

        for key in (policy, stop):
            stack.callback(witness.declare_subscriber(key, zenoh.handlers.Callback(note, indirect=False)).undeclare)
        eventually(lambda: (flooder.put(policy, b"first"), flooder.put(stop, b"first"), len(heard) == 2)[2])
        for number in range(FLOOD):
            flooder.put(policy, b"flood", congestion_control=zenoh.CongestionControl.BLOCK)
            if number == FLOOD // 2:
                other.put(policy, b"other")
            if number % (FLOOD // 10) == 0:
                flooder.put(stop, b"%d" % number)
                flooder.put(stop, b"%d again" % number)
        eventually(lambda: heard[policy, b"other"])
        eventually(lambda: sum(key == stop for key, _ in heard) == 1 + 2 * 10)
        # What came later than the whole flood is heard after it.
        eventually(lambda: (flooder.put(policy, b"last"), heard[policy, b"last"])[1])
    assert 0 < heard[policy, b"flood"] < FLOOD / 2, MOST_PUTS_HZ

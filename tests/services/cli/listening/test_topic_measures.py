"""``smal topic hz`` and ``bw``: the figures, and the commands as an operator runs them."""

from __future__ import annotations

import json
from collections.abc import Iterator

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from schemas.command import Command
from schemas.compressed_image import CompressedImage
from services.cli.listening import commands as listening_commands
from services.cli.listening.arrivals import RATES, SIZES, Arrivals, lines, sizes
from services.kit.bus import Bus
from tests.schemas.messages import EXAMPLES
from tests.services.cli.conftest import Smal
from tests.services.waiting import eventually

KEY = "smal/rescuebot/command/teleop"


@given(st.lists(st.floats(0.001, 10), max_size=30), st.integers(0, 10_000))
def test_rates_and_sizes_are_those_of_what_came(intervals_s: list[float], size: int) -> None:
    times_s = np.cumsum([100.0, *intervals_s])
    heard = Arrivals()
    for time_s in times_s:
        heard.add(size, time_s)
    rates, found = heard.rates(), sizes([heard, Arrivals()], 4.0)
    assert rates["messages"] == found["messages"] == len(times_s)
    assert found["bytes_per_s"] == size * len(times_s) / 4.0
    assert found["mean_bytes"] == found["min_bytes"] == found["max_bytes"] == size
    if not intervals_s:
        assert {value for name, value in rates.items() if name != "messages"} == {None}
        return
    gaps = np.diff(times_s)
    assert rates["rate_hz"] == pytest.approx(1.0 / gaps.mean())
    assert rates["bytes_per_s"] == pytest.approx(size / gaps.mean())
    assert (rates["min_s"], rates["max_s"]) == pytest.approx((gaps.min(), gaps.max()))
    assert (rates["mean_s"], rates["std_s"]) == pytest.approx((gaps.mean(), gaps.std()))
    assert len(list(lines({"key": rates}, RATES))) == len(list(lines({"key": found}, SIZES))) == 2


@pytest.fixture
def talking(client: Bus, router_endpoint: str, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Let the time of listening be over when several messages must have been heard."""
    witness = Bus("rescuebot", router_endpoint)

    def wait(_what: str, _seconds: float) -> None:
        heard: list[str] = []
        witness.listen("smal/**", lambda key, *_: heard.append(key))

        def enough() -> bool:
            client.publish(EXAMPLES[Command])
            client.publish(EXAMPLES[CompressedImage])
            return len(heard) >= 20

        eventually(enough)

    monkeypatch.setattr(listening_commands, "wait", wait)
    yield
    witness.close()


@pytest.mark.usefixtures("talking")
def test_bw_measures_each_key_and_the_total(smal: Smal, router_endpoint: str) -> None:
    status, out, _ = smal("topic", "bw", "--json", "--router", router_endpoint)
    found = json.loads(out)
    assert status == 0
    assert set(found["keys"]) == {KEY, "smal/rescuebot/camera/jpeg"}
    assert found["keys"][KEY]["mean_bytes"] == found["keys"][KEY]["min_bytes"] == found["keys"][KEY]["max_bytes"]
    assert found["total"]["bytes"] == sum(one["bytes"] for one in found["keys"].values())
    assert found["total"]["bytes_per_s"] == found["total"]["bytes"] / found["seconds"]

"""``smal topic hz`` and ``bw``: the figures, and the commands as an operator runs them."""

from __future__ import annotations

import json
import statistics
from collections.abc import Iterator
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from schemas.command import Command
from schemas.image import Image
from services.cli.listening import commands as listening_commands
from services.cli.listening.rates import Rate
from services.kit.bus import Bus
from tests.schemas.messages import EXAMPLES
from tests.services.cli.conftest import Listen, Smal
from tests.services.waiting import eventually

KEY = "smal/rescuebot/command/teleop"


@given(st.lists(st.floats(0.001, 10), min_size=1, max_size=30), st.integers(0, 10_000))
def test_rates(intervals_s: list[float], size: int) -> None:
    times_s = [100.0]
    for interval_s in intervals_s:
        times_s.append(times_s[-1] + interval_s)
    rate = Rate()
    for time_s in times_s:
        rate.add(size, time_s)
    gaps = [later - earlier for earlier, later in pairwise(times_s)]
    assert rate.mean_s == pytest.approx(sum(gaps) / len(gaps))
    assert rate.rate_hz == pytest.approx(len(gaps) / sum(gaps))
    assert rate.bytes_per_s == pytest.approx(size * len(gaps) / sum(gaps))
    assert (rate.min_s, rate.max_s) == (min(gaps), max(gaps))
    assert rate.std_s == pytest.approx(statistics.pstdev(gaps), abs=1e-9)


@pytest.mark.zenoh
def test_hz_measures_each_key_until_ctrl_c(listen: Listen) -> None:
    listening = listen("hz", "--json", "--seconds", "60")
    assert listening.process.stderr is not None
    assert listening.process.stderr.readline() == "listening to smal/rescuebot/** for 60 s\n"
    # The subscription was there before that line was printed, but the router passes it on in the background: it knows
    # the later listener's only after this one's.
    listen("echo", "--count", "20").lines_until(20, EXAMPLES[Command], EXAMPLES[Image])
    status, out, err = listening.end()
    rates = json.loads(out)
    assert (status, err) == (0, "")
    assert rates[KEY]["messages"] >= 2
    assert rates[KEY]["rate_hz"] > 0
    assert rates[KEY]["std_s"] >= 0


@pytest.fixture
def talking(client: Bus, router_endpoint: str, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Let the time of listening be over when several messages must have been heard."""
    witness = Bus("rescuebot", router_endpoint)

    def wait(_what: str, _seconds: float) -> None:
        heard: list[str] = []
        witness.listen("smal/**", lambda key, *_: heard.append(key))

        def enough() -> bool:
            client.publish(EXAMPLES[Command])
            client.publish(EXAMPLES[Image])
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
    assert set(found["keys"]) == {KEY, "smal/rescuebot/camera/rgb"}
    assert found["keys"][KEY]["mean_bytes"] == found["keys"][KEY]["min_bytes"] == found["keys"][KEY]["max_bytes"]
    assert found["total"]["bytes"] == sum(one["bytes"] for one in found["keys"].values())
    assert found["total"]["bytes_per_s"] == found["total"]["bytes"] / found["seconds"]


@pytest.mark.parametrize("command", ["hz", "bw"])
def test_silence(smal: Smal, router_endpoint: str, command: str) -> None:
    code, out, err = smal("topic", command, "pose/truth", "--seconds", "0.1", "--router", router_endpoint)
    assert (code, out) == (0, "")
    assert err.endswith("smal: nothing was published on smal/rescuebot/pose/truth\n")

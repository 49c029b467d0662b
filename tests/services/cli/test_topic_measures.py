"""``smal topic hz``: the figures, and the command as an operator runs it."""

import json
from collections.abc import Iterator

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from schemas.camera import CompressedImage
from schemas.command import Command
from services.cli import listening
from services.cli.listening import Arrivals
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
    found = heard.figures(4.0)
    assert found["messages"] == len(times_s)
    assert found["bytes_per_s"] == size * len(times_s) / 4.0
    assert found["mean_bytes"] == found["max_bytes"] == size
    if not intervals_s:
        assert {found[name] for name in ("rate_hz", "min_s", "max_s", "std_s")} == {None}
        return
    gaps = np.diff(times_s)
    assert found["rate_hz"] == pytest.approx(1.0 / gaps.mean())
    assert (found["min_s"], found["max_s"]) == pytest.approx((gaps.min(), gaps.max()))
    assert found["std_s"] == pytest.approx(gaps.std())


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

    monkeypatch.setattr(listening, "wait", wait)
    yield
    witness.close()


@pytest.mark.usefixtures("talking")
def test_hz_measures_each_key(smal: Smal, router_endpoint: str) -> None:
    status, out, _ = smal("topic", "hz", "--json", "--router", router_endpoint)
    found = json.loads(out)
    assert status == 0
    assert set(found) == {KEY, "smal/rescuebot/camera/jpeg"}
    assert found[KEY]["rate_hz"] > 0.0
    assert found[KEY]["mean_bytes"] == found[KEY]["max_bytes"]

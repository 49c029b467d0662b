"""The latency breakdown: made-up arrivals in, the spread of each hop out."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from schemas.base import Message, Source
from schemas.command import Command, CommandApplied
from schemas.observation import Observation
from schemas.pose import Pose
from schemas.state import State
from services.cli.listening.latency import Hop, LatencyTrace, hops
from tests.schemas.messages import EXAMPLES

_delays_s = st.tuples(*[st.floats(0, 1)] * 4)


def told(cls: type[Message], tick: int, **more: object) -> Message:
    """Give a message of the policy's chain."""
    return EXAMPLES[cls].model_copy(update={"tick": tick, **more})


def command(tick: int, source: Source = "policy") -> Message:
    return told(Command, tick, source=source)


def applied(tick: int, source: Source | None = "policy", answered: int | None = None, ms: float = 12) -> Message:
    return told(
        CommandApplied,
        tick,
        source=source,
        reason="silence" if source is None else "command",
        answered_tick=tick if answered is None else answered,
        latency_ns=round(ms * 1e6),
    )


def drive(trace: LatencyTrace, tick: int, start_s: float, *delays_s: float) -> None:
    """Let one tick of the policy arrive: frame, observation, state, command, applied."""
    at_s = start_s + np.cumsum([0.0, *delays_s])
    chain = (told(Pose, tick), told(Observation, tick), told(State, tick), command(tick), applied(tick))
    for message, when_s in zip(chain, at_s, strict=True):
        trace.see(message, when_s)


def p50s(trace: LatencyTrace, driver: Source) -> dict[Hop, tuple[int, float]]:
    return {hop: (one["ticks"], round(one["p50_ms"], 6)) for hop, one in trace.breakdown(driver).items()}


@given(st.lists(_delays_s, min_size=1, max_size=10))
def test_the_spread_of_every_hop(ticks: list[tuple[float, float, float, float]]) -> None:
    trace = LatencyTrace("pose/truth")
    for tick, delays_s in enumerate(ticks):
        drive(trace, tick, 100.0 + tick, *delays_s)
    assert trace.frames == trace.commands == len(ticks)
    assert trace.drivers() == ["policy"]
    chosen, found = np.array(ticks), trace.breakdown("policy")
    expected = 1e3 * np.c_[chosen[:, :3], chosen[:, :3].sum(axis=1), chosen[:, 3]]
    assert list(found) == hops("policy")
    *timed, accepted = found.values()
    for spread, column in zip(timed, expected.T, strict=True):
        assert spread["ticks"] == len(chosen)
        figures = (spread["p50_ms"], spread["p95_ms"], spread["max_ms"])
        assert figures == pytest.approx((*np.percentile(column, [50, 95]), column.max()), abs=1e-6)
    assert accepted["p50_ms"] == pytest.approx(12.0)


def test_two_drivers_have_each_their_own_chain() -> None:
    trace = LatencyTrace("pose/truth")
    drive(trace, 0, 1.0, 0.1, 0.1, 0.1, 0.5)
    trace.see(command(0, "teleop"), 1.2)
    trace.see(applied(0, "teleop", ms=7), 1.25)
    assert trace.drivers() == ["teleop", "policy"]
    assert p50s(trace, "teleop") == {
        ("frame", "command/teleop"): (1, 200.0),
        ("command/teleop", "command/applied"): (1, 50.0),
        ("frame", "accepted"): (1, 7.0),
    }

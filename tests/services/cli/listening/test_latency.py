"""The latency breakdown: made-up arrivals in, the spread of each hop out."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from schemas.base import Message, Source
from schemas.command import CommandApplied
from services.cli.listening.latency import ACCEPTED, OPEN_TICKS, Hop, LatencyTrace, hops

POLICY_HOPS: list[Hop] = [
    ("frame", "observation"),
    ("observation", "state"),
    ("state", "command/policy"),
    ("frame", "command/policy"),
    ("command/policy", "command/applied"),
]
_delays_s = st.tuples(*[st.floats(0, 1)] * 4, st.booleans())


def header(tick: int, episode: str = "e") -> Message:
    return Message(robot="rescuebot", episode=episode, tick=tick, stamp_ns=0)


def applied(tick: int, source: Source | None = "policy", answered: int | None = None, ms: float = 12) -> CommandApplied:
    return CommandApplied.after(
        header(tick),
        atom="forward",
        speed=1.0,
        source=source,
        reason="silence" if source is None else "command",
        answered_tick=tick if answered is None else answered,
        latency_ns=round(ms * 1e6),
    )


def drive(trace: LatencyTrace, tick: int, start_s: float, *delays_s: float, decided: bool = False) -> None:
    """Let one tick of the policy arrive: frame, observation, state, command, applied."""
    at_s = start_s + np.cumsum([0.0, *delays_s])
    trace.frame(header(tick), at_s[0])
    trace.arrived("observation", header(tick), at_s[1])
    trace.arrived("state", header(tick), at_s[2])
    trace.arrived("command/policy", header(tick), at_s[3])
    if decided:
        # Another session, another priority: the decision may come after the command that carries it out.
        trace.arrived("action", header(tick), at_s[3] + 0.001)
    trace.applied(applied(tick), at_s[4])


def finished(fill: Callable[[LatencyTrace], None]) -> LatencyTrace:
    trace = LatencyTrace()
    fill(trace)
    trace.finish()
    return trace


def p50s(trace: LatencyTrace, driver: Source, *, decisions_only: bool = False) -> dict[Hop, tuple[int, float]]:
    found = trace.breakdown(driver, decisions_only=decisions_only)
    return {hop: (spread.ticks, round(spread.p50_ms, 6)) for hop, spread in found.items()}


@given(st.lists(_delays_s, min_size=1, max_size=2 * OPEN_TICKS))
def test_the_spread_of_every_hop(ticks: list[tuple[float, float, float, float, bool]]) -> None:
    trace = LatencyTrace()
    for tick, (*delays_s, decided) in enumerate(ticks):
        drive(trace, tick, 100.0 + tick, *delays_s, decided=decided)
    trace.finish()
    assert trace.frames == trace.commands == len(ticks)
    assert trace.drivers() == ["policy"]
    for decisions_only in (False, True):
        chosen = np.array([delays_s for *delays_s, decided in ticks if decided or not decisions_only]).reshape(-1, 4)
        found = trace.breakdown("policy", decisions_only=decisions_only)
        if not len(chosen):
            assert found == {}
            continue
        expected = 1e3 * np.c_[chosen[:, :3], chosen[:, :3].sum(axis=1), chosen[:, 3]]
        assert list(found) == [*POLICY_HOPS, ACCEPTED]
        for hop, column in zip(POLICY_HOPS, expected.T, strict=True):
            spread = found[hop]
            assert spread.ticks == len(chosen)
            assert spread.p50_ms == pytest.approx(np.median(column), abs=1e-6)
            assert spread.p95_ms == pytest.approx(np.percentile(column, 95), abs=1e-6)
            assert spread.max_ms == pytest.approx(column.max(), abs=1e-6)
        assert found[ACCEPTED].p50_ms == pytest.approx(12.0)


def test_a_frame_sent_again_counts_from_the_first_time() -> None:
    def fill(trace: LatencyTrace) -> None:
        trace.frame(header(0), 1.0)
        trace.frame(header(0), 3.0)
        for repeat_s in (0.0, 0.5):
            trace.arrived("observation", header(0), 3.1 + repeat_s)
            trace.arrived("state", header(0), 3.2 + repeat_s)
            trace.arrived("command/policy", header(0), 3.3 + repeat_s)
            trace.applied(applied(0), 3.4 + repeat_s)

    trace = finished(fill)
    assert trace.frames == 1
    assert p50s(trace, "policy")["frame", "observation"] == (1, 2100.0)
    assert p50s(trace, "policy")["frame", "command/policy"] == (1, 2300.0)
    assert p50s(trace, "policy")["command/policy", "command/applied"] == (1, 100.0)


def test_two_drivers_have_each_their_own_chain() -> None:
    def fill(trace: LatencyTrace) -> None:
        trace.frame(header(0), 1.0)
        trace.arrived("command/teleop", header(0), 1.005)
        trace.arrived("observation", header(0), 1.01)
        trace.arrived("command/expert", header(0), 1.02)
        trace.arrived("state", header(0), 1.04)
        trace.arrived("command/policy", header(0), 1.08)
        trace.arrived("command/emergency_stop", header(0), 1.001)
        trace.applied(applied(1, "teleop", answered=0, ms=6), 1.1)
        trace.applied(applied(1, None), 1.2)

    trace = finished(fill)
    assert trace.drivers() == ["teleop", "expert", "policy"]
    assert trace.commands == 3
    assert p50s(trace, "teleop") == {
        ("frame", "command/teleop"): (1, 5.0),
        ("command/teleop", "command/applied"): (1, 95.0),
        ACCEPTED: (1, 6.0),
    }
    assert p50s(trace, "expert") == {
        ("frame", "observation"): (1, 10.0),
        ("observation", "command/expert"): (1, 10.0),
        ("frame", "command/expert"): (1, 20.0),
    }
    assert p50s(trace, "policy")["state", "command/policy"] == (1, 40.0)
    assert ACCEPTED not in p50s(trace, "policy"), "never obeyed"


def test_in_real_time_a_command_is_applied_in_a_later_tick_and_repeated_while_it_holds() -> None:
    def fill(trace: LatencyTrace) -> None:
        for tick in range(3):
            trace.frame(header(tick), tick)
        trace.arrived("command/policy", header(0), 0.25)
        for tick in (1, 2):
            trace.applied(applied(tick, answered=0, ms=240), tick + 0.01)

    trace = finished(fill)
    assert p50s(trace, "policy")["command/policy", "command/applied"] == (1, 760.0)
    assert p50s(trace, "policy")[ACCEPTED] == (1, 240.0)


def test_hops_add_up() -> None:
    assert hops("policy") == POLICY_HOPS
    assert hops("teleop") == [("frame", "command/teleop"), ("command/teleop", "command/applied")]

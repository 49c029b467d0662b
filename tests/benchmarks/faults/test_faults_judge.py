"""The judgements of faults, with logs that must pass and logs that must fail."""

import pytest

from schemas.topics import ACTION, APPLIED, COMMANDS, JPEG, POSE
from tests.benchmarks.faults import judge
from tests.benchmarks.faults.cells import Cell, Limits
from tests.benchmarks.faults.judge import Entry, Window
from tests.benchmarks.faults.recordings import Recorded, lost, place_of, unsaid
from tests.benchmarks.faults.run import NEVER, Outcome, verdict
from tests.benchmarks.faults.wheels import Step


def steps(*spans: tuple[float, float], atom: str = "forward", period_s: float = 0.1) -> list[Step]:
    """Return the log of a base that moves in these spans, by an order every so often."""
    moves = [
        (t, any(begin < t <= end for begin, end in spans))
        for t in (0.02 * k for k in range(1, 200))
    ]
    return [Step(t, t - t % period_s, 2.0 * moved, atom if moved else "stop") for t, moved in moves]


def commanded(*at_s: float) -> list[Entry]:
    """Return what is seen of a driver that commands for frames captured at these times."""
    policy = COMMANDS["policy"].name
    return [Entry(t + 0.05, t, policy, "e", k, {"atom": "forward"}) for k, t in enumerate(at_s)]


def obeyed(answered: range) -> list[Entry]:
    """Return what is seen of an actuator that obeys the command of each frame 30 ms after its capture."""
    told = {"reason": "command", "latency_ns": 30_000_000, "atom": "forward"}
    frames = [Entry(0.1 * k, 0.1 * k, POSE.name, "e", k) for k in range(40)]
    return frames + [
        Entry(0.1 * k, 0.1 * k, APPLIED.name, "e", k + 1, told | {"answered_tick": k})
        for k in answered
    ]


EVERY_FRAME = [0.1 * k for k in range(11)]


def test_how_long_a_base_moves_on_is_told_by_its_own_log() -> None:
    asked = judge.asked(commanded(*EVERY_FRAME))
    assert judge.still_s(steps((0.2, 1.41)), asked) == pytest.approx(0.4, abs=0.001)
    assert judge.stale_orders(steps((0.2, 1.41)), asked) == []
    assert judge.still_s(steps((0.2, 1.41), (3.0, 3.03)), asked) == pytest.approx(2.02, abs=0.001)
    assert judge.still_s(steps(), asked) == 0.0


@pytest.mark.parametrize(
    ("moved", "driver"),
    [
        (steps((0.2, 1.0), (3.0, 3.1)), commanded(*EVERY_FRAME)),  # long after the last command
        (steps((0.2, 1.0), atom="left"), commanded(*EVERY_FRAME)),  # by another one
        (steps((0.2, 1.0)), commanded()),  # by none
    ],
)
def test_a_base_that_moves_by_no_valid_command(moved: list[Step], driver: list[Entry]) -> None:
    assert judge.stale_orders(moved, judge.asked(driver))
    assert judge.still_s(moved, judge.asked(driver)) > 0.5


def test_recovery_pause_and_rate() -> None:
    """Recovery counts only frames captured after the fault."""
    frames = judge.obeyed(obeyed(range(36)))
    assert judge.recovery_s(frames, 2.05) == pytest.approx(0.05 + 0.03, abs=0.005)
    assert judge.recovery_s(frames, 3.6) is None
    assert judge.longest_pause_s(frames, Window(0.5, 3.0)) < 0.2
    fewer = judge.obeyed(obeyed(range(10)) + obeyed(range(20, 36)))
    assert judge.longest_pause_s(fewer, Window(0.5, 3.0)) == pytest.approx(1.1, abs=0.01)
    assert judge.rate_hz(obeyed(range(0)), POSE.name, Window(0.0, 2.0)) == pytest.approx(10.0)
    assert judge.drives(obeyed(range(36)), "e")
    assert not judge.drives(obeyed(range(36)), "other")


# -- recordings -------------------------------------------------------------------------------------------------------


def seen(ticks: int, *without: int) -> list[Entry]:
    topics = (POSE.name, JPEG.name, APPLIED.name, ACTION.name)
    return [
        Entry(0.0, 0.0, topic, "e", k) for k in range(ticks) if k not in without for topic in topics
    ]


def recording(entries: list[Entry], *missing: tuple[str, int]) -> Recorded:
    places = {
        place_of(one.topic, one.tick, one.told)
        for one in entries
        if (one.topic, one.tick) not in missing
    }
    return Recorded(places=places, ended=True)


def test_what_is_lost_is_named_and_must_be_said() -> None:
    assert lost(seen(20), recording(seen(20))) == {}
    recorded = recording(
        seen(20), (POSE.name, 3), (POSE.name, 4), (ACTION.name, 4), (ACTION.name, 9)
    )
    missing = lost(seen(20), recorded)
    assert missing == {ACTION.name: [4, 9], POSE.name: [3, 4]}
    assert unsaid(missing, recorded) == {POSE.name: [3, 4]}
    recorded.gaps[POSE.name] = {3, 4}
    assert unsaid(missing, recorded) == {}


# -- verdicts ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("cost", "cell", "not_met"),
    [
        ({}, {}, []),
        ({"still_s": 0.6}, {}, ["stand still"]),
        ({"stale": ["the base obeyed forward"]}, {}, ["stale"]),
        ({"recovery_s": 1.2}, {}, ["recovery"]),
        ({"recovery_s": None}, {}, ["recovery"]),
        ({"lost_ticks": 1}, {}, ["lost"]),
        ({"duplicates": 1}, {}, ["twice"]),
        ({"unsaid": {"e pose/truth": [1]}}, {}, ["gap not said"]),
        ({"unreadable": ["e.mcap.partial"]}, {}, ["not finished"]),
        ({"pause_s": 1.2}, {"limits": Limits(pause_s=1.0)}, ["pause"]),
        ({"rate_hz": 8.0}, {"limits": Limits(rate_hz=9.0)}, ["rate"]),
        ({}, {"watched": "recorder"}, ["recovery"]),
        ({"restart_s": 2.0}, {"watched": "recorder"}, []),
        ({"stood_s": 0.45, "moved_again_s": 0.1}, {"stands": True}, []),
        ({"stood_s": 0.6, "moved_again_s": 0.1}, {"stands": True}, ["stand"]),
        ({"stood_s": None, "moved_again_s": 0.1}, {"stands": True}, ["stand"]),
        ({"stood_s": 0.45}, {"stands": True}, ["drive again"]),
        ({"stood_s": 0.0}, {"abandoned": True}, []),
        ({"stood_s": 3.3}, {"abandoned": True}, ["stand"]),
    ],
)
def test_verdicts(cost: dict[str, object], cell: dict[str, object], not_met: list[str]) -> None:
    outcome = Outcome("a fault", NEVER, **({"still_s": 0.44, "recovery_s": 0.2} | cost))  # type: ignore[arg-type]
    assert verdict(Cell("a fault", lambda _rig: NEVER, **cell), outcome) == not_met  # type: ignore[arg-type]

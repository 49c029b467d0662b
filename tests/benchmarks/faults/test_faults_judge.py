"""The judgements over an observer's log, with logs that must pass and logs that must fail."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from schemas.base import NO_EPISODE
from schemas.topics import ACTION, APPLIED, COMMANDS, JPEG, OBSERVATION, POSE, PULSE
from services.recordings.ledger import Ledger
from services.recordings.writer import EpisodeWriter
from tests.benchmarks.faults import judge
from tests.benchmarks.faults.cells import MATRIX, QUICK, Cell, Limits
from tests.benchmarks.faults.judge import Window
from tests.benchmarks.faults.log import Entry, Step, Tail, entry_of, parse, read_log
from tests.benchmarks.faults.recordings import Recorded, balance, read_recordings, ticks_of
from tests.benchmarks.faults.run import Outcome, verdict
from tests.benchmarks.faults.track import Track, tracks
from tests.schemas.messages import EXAMPLES
from tests.services.recordings.recorded_messages import event, frame
from tests.services.recordings.test_recorder_files import record

BEGIN_S = 1000.0
NEVER = Window(0.0, 0.0)


def pose(tick: int, x_m: float, at_s: float, late_s: float = 0.001) -> Entry:
    told = {"x_m": x_m, "y_m": 0.0, "heading_rad": 0.0}
    return Entry(BEGIN_S + at_s + late_s, POSE.name, "e", tick, round(at_s * 1e9), (tick,), told)


def applied(tick: int, answered: int | None, at_s: float, sequence: int = 0, said_s: float | None = None) -> Entry:
    told = {"sequence": sequence, "reason": "silence" if answered is None else "command"}
    if answered is not None:
        told |= {"answered_tick": answered, "latency_ns": 30_000_000}
    arrival_s = BEGIN_S + (at_s + 0.001 if said_s is None else said_s)
    return Entry(arrival_s, APPLIED.name, "e", tick, round(at_s * 1e9), (tick, sequence), told)


def drive(stopped_after_s: float, last_answered: int = 10, ticks: int = 40) -> list[Entry]:
    """Return the log of a robot that moves until so long after the capture of the last answered frame."""
    entries, x_m = [], 0.0
    stops_s = last_answered * 0.1 + stopped_after_s
    for tick in range(ticks):
        at_s = tick * 0.1
        entries.append(pose(tick, x_m, at_s))
        obeys = at_s <= stops_s - 1e-9
        entries.append(applied(tick, min(tick - 1, last_answered) if obeys and tick else None, at_s))
        x_m += 2.0 * max(0.0, min(0.1, stops_s - at_s))
    return entries


@pytest.mark.parametrize("after_s", [0.2, 0.35, 0.44, 0.5])
def test_a_robot_that_stops_in_time(after_s: float) -> None:
    found = judge.stand_still(Track("e", drive(after_s)), NEVER)
    assert found.at_least_s == pytest.approx(max(after_s, 0.2), abs=0.005)
    assert found.at_most_s == pytest.approx(found.at_least_s, abs=0.005)


@pytest.mark.parametrize("after_s", [0.6, 1.0])
def test_a_robot_that_moves_on_after_its_last_command(after_s: float) -> None:
    track = Track("e", drive(after_s))
    assert judge.stand_still(track, NEVER).at_least_s == pytest.approx(after_s, abs=0.005)
    assert bool(judge.stale(track)) == (after_s > 0.61)


def test_a_robot_without_a_processor_leaves_it_open_when_the_robot_stopped() -> None:
    """It may have moved at the end of a tick that took 0.3 s of the clock; the actuator's word closes the gap."""
    late = [
        Entry(one.t_s + 0.2, one.topic, "e", one.tick, one.stamp_ns + 200_000_000, one.order, one.told)
        if one.tick > 14
        else one
        for one in drive(0.44)
    ]
    found = judge.stand_still(Track("e", late), NEVER)
    assert found.at_least_s == pytest.approx(0.44, abs=0.005)
    assert found.at_most_s == pytest.approx(0.7, abs=0.005)
    said = applied(14, None, 1.4, sequence=1, said_s=1.46)
    assert judge.stand_still(Track("e", [*late, said]), NEVER).at_most_s == pytest.approx(0.46, abs=0.005)


def test_a_robot_that_moves_without_any_command() -> None:
    entries = [pose(tick, 0.2 * tick, 0.1 * tick) for tick in range(20)]
    assert judge.stand_still(Track("e", entries), NEVER).at_least_s == pytest.approx(1.9, abs=0.01)


def test_a_robot_that_stands_however_long() -> None:
    assert judge.stand_still(Track("e", [pose(k, 3.0, 0.1 * k) for k in range(50)]), NEVER) == judge.Still()


def frozen(way_m: float, answered: int | None) -> Track:
    """Return a log of a robot whose process was frozen from 0.25 to 3.25 s, and the way it made in that tick."""
    before = [one for k in range(3) for one in (pose(k, 0.2 * k, 0.1 * k), applied(k, max(0, k - 1), 0.1 * k))]
    after = [one for k in range(3, 6) for at_s in [3.0 + 0.1 * k] for one in (
        pose(k, 0.4 + way_m, at_s), applied(k, answered, at_s))]  # fmt: skip
    return Track("e", before + after)


@pytest.mark.parametrize("way_m", [0.1, 0.5])
@pytest.mark.parametrize("begin_s", [0.18, 0.25])  # the frame before is stamped a little late
def test_a_simulated_base_stands_by_its_watchdog_while_its_process_is_frozen(way_m: float, begin_s: float) -> None:
    fault = Window(BEGIN_S + begin_s, BEGIN_S + 3.25)
    assert judge.stand_still(frozen(way_m, None), fault).at_most_s < 0.5


def test_a_simulated_base_that_moves_on_when_its_process_wakes() -> None:
    fault = Window(BEGIN_S + 0.25, BEGIN_S + 3.25)
    assert judge.stand_still(frozen(1.0, None), fault).at_most_s > 3.0


def test_a_stale_command_after_a_freeze() -> None:
    assert judge.stale(frozen(0.0, None)) == []
    found = judge.stale(frozen(0.0, 2))
    assert len(found) == 3
    assert "frame 3" in found[0]
    assert "frame 2" in found[0]


def test_what_was_replayed_late_is_judged_by_its_stamps() -> None:
    late = [Entry(BEGIN_S + 30.0, *list(vars(one).values())[1:]) for one in drive(0.4) if one.tick > 5]
    track = Track("e", [one for one in drive(0.4) if one.tick <= 5] + late)
    assert judge.stand_still(track, NEVER).at_most_s == pytest.approx(0.4, abs=0.005)


def test_recovery_counts_only_frames_captured_after_the_fault() -> None:
    track = Track("e", drive(0.4, last_answered=35))
    at_s = judge.recovery_s([track], BEGIN_S + 2.05)
    assert at_s == pytest.approx(0.05 + 0.03, abs=0.005)
    assert judge.recovery_s([track], BEGIN_S + 3.6) is None
    assert judge.flows([track], BEGIN_S + 2.05, 10)
    assert not judge.flows([track], BEGIN_S + 2.95, 10)


def test_the_longest_pause() -> None:
    entries = drive(0.4, last_answered=35)
    fewer = [one for one in entries if one.topic == POSE.name or not 11 <= one.tick <= 20]
    whole = Window(BEGIN_S + 0.5, BEGIN_S + 3.0)
    assert judge.longest_pause_s([Track("e", entries)], whole) < 0.2
    assert judge.longest_pause_s([Track("e", fewer)], whole) == pytest.approx(1.1, abs=0.01)


def test_rates() -> None:
    track = Track("e", [pose(k, 0.0, 0.1 * k) for k in range(100)])
    assert judge.rate_hz([track], POSE.name, Window(BEGIN_S, BEGIN_S + 8.0)) == pytest.approx(10.0)
    assert judge.rate_hz([track], JPEG.name, Window(BEGIN_S, BEGIN_S + 8.0)) == 0.0


def test_only_a_robot_that_moves_by_commands_is_moving() -> None:
    entries = drive(0.4, last_answered=35)
    assert judge.moving(Track("e", [one for one in entries if one.tick < 20]))
    assert not judge.moving(Track("e", entries))
    assert not judge.moving(Track("e", [one for one in entries if one.tick < 20 and one.topic == POSE.name][:2]))


# -- a moving base ----------------------------------------------------------------------------------------------------


def steps(*spans: tuple[float, float], atom: str = "forward", period_s: float = 0.1) -> list[Step]:
    """Return the log of a base that moves in these spans, by an order every so often."""
    times = [0.02 * k for k in range(1, 200)]
    moves = [any(begin < t <= end for begin, end in spans) for t in times]
    return [
        Step(BEGIN_S + t, 0.0, 0.0, 0.0, 2.0 * moved, atom if moved else "stop", BEGIN_S + t - t % period_s)
        for t, moved in zip(times, moves, strict=True)
    ]


def commanded(*at_s: float, atom: str = "forward") -> Track:
    """Return the log of a driver that commands for frames captured at these times; others are left alone."""
    policy = COMMANDS["policy"].name
    return Track(
        "e", [Entry(BEGIN_S + t + 0.05, policy, "e", k, round(t * 1e9), (k,), {"atom": atom}) for k, t in
              enumerate(at_s)], BEGIN_S)  # fmt: skip


def test_how_long_a_base_moves_on_is_told_by_its_own_log() -> None:
    track = commanded(*(0.1 * k for k in range(11)))
    asked = judge.commands([track])
    assert judge.rolled_on(steps((0.2, 1.41)), asked).at_least_s == pytest.approx(0.4, abs=0.001)
    assert judge.stale_orders(steps((0.2, 1.41)), asked) == []
    assert judge.rolled_on(steps((0.2, 1.41), (3.0, 3.03)), asked).at_least_s == pytest.approx(2.02, abs=0.001)
    assert judge.rolled_on(steps(), asked) == judge.Still()


@pytest.mark.parametrize(
    ("moved", "asked"),
    [
        (steps((0.2, 1.0), (3.0, 3.1)), commanded(*(0.1 * k for k in range(11)))),  # long after the last command
        (steps((0.2, 1.0), atom="left"), commanded(*(0.1 * k for k in range(11)))),  # by another one
        (steps((0.2, 1.0)), commanded()),  # by none
    ],
)
def test_a_base_that_moves_by_no_valid_command(moved: list[Step], asked: Track) -> None:
    assert judge.stale_orders(moved, judge.commands([asked]))
    assert judge.rolled_on(moved, judge.commands([asked])).at_least_s > 0.5


def test_when_a_base_stood_after_a_fault_and_moved_again() -> None:
    fault = Window(BEGIN_S + 1.0, BEGIN_S + 2.0)
    stood_s, again_s = judge.stood_s(steps((0.2, 1.2), (2.5, 3.0)), fault)
    assert (stood_s, again_s) == (pytest.approx(0.2, abs=0.001), pytest.approx(0.52, abs=0.001))
    assert judge.stood_s(steps((0.2, 0.96)), fault) == (0.0, None)
    assert judge.stood_s(steps((0.2, 3.0)), fault) == (pytest.approx(2.0, abs=0.001), None)
    assert judge.stood_s(steps((0.2, 0.5), (1.1, 1.5)), fault) == (None, None)


def test_how_long_after_a_fault_a_base_still_moved_that_may_have_stood_before() -> None:
    fault = Window(BEGIN_S + 1.0, BEGIN_S + 2.0)
    assert judge.moved_on_s(steps((0.2, 0.5), (2.1, 3.0)), fault) == 0.0
    assert judge.moved_on_s(steps((0.2, 1.3), (1.5, 1.7), (2.1, 3.0)), fault) == pytest.approx(0.7, abs=0.001)


# -- recordings -------------------------------------------------------------------------------------------------------


def seen(ticks: int) -> Track:
    return Track("e", [
        one for k in range(ticks) for one in (
            pose(k, 0.0, 0.1 * k), Entry(BEGIN_S, JPEG.name, "e", k, 0, (k,)), applied(k, k, 0.1 * k),
            Entry(BEGIN_S, ACTION.name, "e", k, 0, (k,)))])  # fmt: skip


def recording(track: Track, *lost: tuple[str, int]) -> Recorded:
    recorded = Recorded(files=["e.mcap"])
    for topic, of_it in track.topics.items():
        recorded.places.update((topic, order) for order in of_it if (topic, order[0]) not in lost)
    return recorded


def test_a_whole_recording() -> None:
    found = balance(seen(20), recording(seen(20)))
    assert (found.lost, found.duplicates, found.unsaid, found.published) == ({}, 0, {}, 80)


def test_what_is_lost_is_named_and_must_be_said() -> None:
    recorded = recording(seen(20), (POSE.name, 3), (POSE.name, 4), (ACTION.name, 4), (ACTION.name, 9))
    found = balance(seen(20), recorded)
    assert found.lost == {ACTION.name: [4, 9], POSE.name: [3, 4]}
    assert found.lost_ticks == 3
    assert found.unsaid == {POSE.name: [3, 4]}
    recorded.places.add(("episode", (19, "ended")))
    recorded.gaps[POSE.name] = {3, 4}
    assert balance(seen(20), recorded).unsaid == {}


def test_a_frame_that_nobody_saw_is_lost_all_the_same() -> None:
    whole = seen(20)
    holed = Track("e", [one for topic in whole.topics.values() for one in topic.values() if one.tick not in (7, 8)])
    found = balance(holed, recording(holed))
    assert found.lost == {topic: [7, 8] for topic in sorted((APPLIED.name, JPEG.name, POSE.name))}


def test_a_recording_that_was_cut_says_so_by_having_no_end() -> None:
    recorded = recording(seen(20), *((POSE.name, tick) for tick in range(12, 20)))
    assert balance(seen(20), recorded).unsaid == {}
    assert balance(seen(20), recorded).lost_ticks == 8
    recorded.places.add(("episode", (19, "ended")))
    assert balance(seen(20), recorded).unsaid == {POSE.name: list(range(12, 20))}


def test_what_is_twice_in_a_file_is_counted_and_what_two_files_have_is_not(tmp_path: Path) -> None:
    """A recorder that was killed and started again has what the senders kept."""
    sent = [event("e", 0, "started"), *(one for tick in range(6) for one in frame("e", tick))]
    record(tmp_path, sent[:40])
    record(tmp_path, [sent[0], *sent[30:]])
    (found,) = read_recordings(tmp_path).values()
    assert (len(found.places), found.duplicates, found.files) == (len(sent), 0, ["e-2.mcap", "e.mcap"])
    writer = EpisodeWriter.begin(tmp_path, sent[0])
    writer.write(sent[1])
    writer.ledger = Ledger()
    writer.write(sent[1])
    writer.seal()
    assert read_recordings(tmp_path)["e"].duplicates == 1


def test_ticks_are_read_as_the_recorder_writes_them() -> None:
    assert ticks_of("3-5 9") == {3, 4, 5, 9}
    assert ticks_of("") == set()


# -- the log ----------------------------------------------------------------------------------------------------------


def test_a_log_comes_back_and_holds_nothing_big(tmp_path: Path) -> None:
    entries = [entry_of(message, 1.5) for message in EXAMPLES.values()]
    lines = [one.line() for one in entries]
    assert parse(lines) == entries
    assert max(map(len, lines)) < 1000
    assert {one["topic"] for one in map(json.loads, lines)} >= {POSE.name, OBSERVATION.name, APPLIED.name}
    path = tmp_path / "log"
    path.write_text("".join(lines)[:-5])
    assert read_log(path) == entries[:-1]
    tail = Tail(path)
    assert tail.read() == entries[:-1]
    with path.open("a") as file:
        file.write("".join(lines)[-5:])
    assert tail.read() == entries[-1:]
    assert tail.read() == []
    tail.close()


def test_episodes_are_kept_apart() -> None:
    log = [*drive(0.4), Entry(1.0, POSE.name, "other", 0, 0, (0,), {"x_m": 0.0, "y_m": 0.0, "heading_rad": 0.0})]
    pulse = Entry(1.0, PULSE.name, NO_EPISODE, 0, 0, (0,))
    assert [one.episode for one in tracks([pulse, *log])] == ["e", "other"]


# -- verdicts ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("cost", "not_met"),
    [
        ({}, []),
        ({"still": judge.Still(0.6, 0.6)}, ["stand still"]),
        ({"still": judge.Still(0.45, 0.6)}, ["stand still (not sure)"]),
        ({"stale": ["frame 9 obeyed the command for frame 1"]}, ["stale"]),
        ({"recovery_s": 1.2}, ["recovery"]),
        ({"recovery_s": None}, ["recovery"]),
        ({"lost_ticks": 1}, ["lost"]),
        ({"duplicates": 1}, ["twice"]),
        ({"unsaid": {"e pose/truth": [1]}}, ["gap not said"]),
        ({"unreadable": ["e.mcap.partial"]}, ["not finished"]),
    ],
)
def test_verdicts(cost: dict[str, object], not_met: list[str]) -> None:
    cell = Cell("freeze policy 1 s", lambda _rig: NEVER, Limits())
    outcome = Outcome(cell.name, NEVER, **({"still": judge.Still(0.44, 0.46), "recovery_s": 0.2} | cost))  # type: ignore[arg-type]
    assert verdict(cell, outcome) == not_met


@pytest.mark.parametrize(
    ("stood_s", "again_s", "not_met"),
    [(0.45, 0.1, []), (0.6, 0.1, ["stand"]), (None, 0.1, ["stand"]), (0.45, None, ["drive again"])],
)
def test_a_robot_that_has_to_stand(stood_s: float | None, again_s: float | None, not_met: list[str]) -> None:
    cell = Cell("freeze policy 1 s", lambda _rig: NEVER, Limits(), stands=True)
    assert verdict(cell, Outcome(cell.name, NEVER, recovery_s=0.2, stood_s=stood_s, moved_again_s=again_s)) == not_met


@pytest.mark.parametrize(("stood_s", "not_met"), [(0.0, []), (0.5, []), (3.3, ["stand"]), (None, ["stand"])])
def test_a_robot_whose_operator_is_gone(stood_s: float | None, not_met: list[str]) -> None:
    cell = Cell("kill -9 operator", lambda _rig: NEVER, abandoned=True)
    assert verdict(cell, Outcome(cell.name, NEVER, recovery_s=0.2, stood_s=stood_s)) == not_met


def test_a_killed_service_that_does_not_come_back_is_no_recovery() -> None:
    cell = Cell("kill -9 recorder", lambda _rig: NEVER, Limits(recovery_s=15.0), watched="recorder")
    assert verdict(cell, Outcome(cell.name, NEVER, recovery_s=0.1)) == ["recovery"]
    assert verdict(cell, Outcome(cell.name, NEVER, recovery_s=0.1, restart_s=2.0)) == []


def test_the_matrix_has_every_fault_once() -> None:
    names = [cell.name for cell in MATRIX]
    assert len(set(names)) == len(names)
    assert set(QUICK) <= set(names)
    for service in ("router", "robot", "features", "recognition", "policy", "recorder"):
        assert f"kill -9 {service}" in names
        assert {f"freeze {service} {seconds} s" for seconds in (1, 3, 14)} <= set(names)
        assert f"kill -9 {service}, moving base" in names

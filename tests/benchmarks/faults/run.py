"""Running one cell on a rig, and judging what was observed, what the base did and what was recorded."""

import os
import time
from collections import Counter
from dataclasses import dataclass, field
from typing import Any, Final

from schemas.base import NO_EPISODE
from schemas.topics import COMMANDS, JPEG, OBSERVATION, POSE, STATE
from services.simulator.base import STEP_S
from tests.benchmarks.faults import judge
from tests.benchmarks.faults.cells import Cell
from tests.benchmarks.faults.judge import Entry, Window
from tests.benchmarks.faults.recordings import Recorded, lost, read_recordings, unsaid
from tests.benchmarks.faults.rig import Rig

# Given up after so long; a renderer that starts anew on a busy machine has taken 50 s.
_RECOVERY_S: Final = 60.0
#: After the recovery the loop goes on for so many answered frames, so that what comes late is seen.
_AFTERWARDS: Final = 15
_FOUND_S: Final = 120.0  # Until the robot has found its victim, however busy the machine is: some 15 s undisturbed.
_TRIES: Final = 3
NEVER: Final = Window(0.0, 0.0)
_RATED: Final = (JPEG.name, POSE.name, OBSERVATION.name, STATE.name, COMMANDS["policy"].name)


@dataclass
class Outcome:
    """What a cell cost, in seconds, as limits and columns are; None where it did not happen or is not judged.

    ``lost`` and ``unsaid`` are the ticks that are not recorded, and those of them that the recording does not tell, by
    episode and topic. Above the machine's number of cores ``load`` says that others waited, and times say little.
    """

    name: str
    fault: Window = NEVER
    still_s: float = 0.0
    stood_s: float | None = None
    moved_again_s: float | None = None
    stale: list[str] = field(default_factory=list)
    recovery_s: float | None = None
    restart_s: float | None = None
    pause_s: float = 0.0
    rate_hz: float | None = None
    lost_ticks: int = 0
    lost: dict[str, list[int]] = field(default_factory=dict)
    unsaid: dict[str, list[int]] = field(default_factory=dict)
    duplicates: int = 0
    recorded: int = 0
    unreadable: list[str] = field(default_factory=list)
    load: float = field(default_factory=lambda: os.getloadavg()[0])
    notes: list[str] = field(default_factory=list)
    outcomes: dict[str, int] = field(default_factory=dict)
    not_met: list[str] = field(default_factory=list)

    def record(self) -> dict[str, Any]:
        """Return what JSON is to hold."""
        return vars(self) | {"fault": list(self.fault), "met": not self.not_met}


def run_cell(cell: Cell, rig: Rig) -> Outcome:
    """Do the harm while the robot drives, wait for the recovery, and judge; again if the robot happened to stand."""
    for _ in range(_TRIES):
        outcome = _run(cell, rig)
        if not cell.stands or outcome.stood_s is not None:
            break
    return outcome


def _run(cell: Cell, rig: Rig) -> Outcome:
    rig.start_moving()
    watched = rig.pid(cell.watched) if cell.watched else 0
    rig.driven = cell.drives_on
    outcome = Outcome(cell.name, cell.harm(rig))
    rig.driven = cell.instances == 1
    end_s = outcome.fault.end_s
    if cell.watched and rig.until(lambda: rig.ready(str(cell.watched), watched), _RECOVERY_S):
        outcome.restart_s = time.monotonic() - end_s

    def flows() -> bool:
        return sum(one.captured_s >= end_s for one in judge.obeyed(rig.entries)) >= _AFTERWARDS

    rig.until(flows, _RECOVERY_S)
    over_s = time.monotonic()
    if cell.instances > 1:
        rig.until(rig.ended, _FOUND_S)
        outcome.outcomes = dict(sum((one.outcomes for one in (rig, *rig.others)), Counter()))
    harmed = {one.episode for one in rig.entries}
    rig.finish_episode()
    steps = rig.steps()
    entries = rig.entries
    outcome.notes = rig.notes
    _judge(cell, outcome, entries, steps, over_s)
    if cell.next_episode:
        rig.start_moving()
        rig.finish_episode()
        entries = entries + rig.entries
        outcome.notes = outcome.notes + rig.notes
    _compare(
        outcome,
        entries,
        read_recordings(rig.plan.recordings),
        harmed if cell.next_episode else set(),
    )
    outcome.not_met = verdict(cell, outcome)
    return outcome


def _judge(
    cell: Cell, outcome: Outcome, entries: list[Entry], steps: list[Any], over_s: float
) -> None:
    """Judge what the robot did."""
    fault = outcome.fault
    asked = judge.asked(entries)
    frames = judge.obeyed(entries)
    outcome.still_s = judge.still_s(steps, asked)
    outcome.stale = judge.stale_orders(steps, asked)
    if cell.stands:
        outcome.stood_s, outcome.moved_again_s = judge.stood_s(steps, fault)
    elif cell.abandoned:
        outcome.stood_s = judge.moved_on_s(steps, fault)
    outcome.recovery_s = judge.recovery_s(frames, fault.end_s)
    back_s = over_s if outcome.recovery_s is None else fault.end_s + outcome.recovery_s
    outcome.pause_s = judge.longest_pause_s(frames, Window(fault.begin_s - 0.5, back_s))
    if cell.limits.rate_hz is not None:
        outcome.rate_hz = min(judge.rate_hz(entries, topic, fault) for topic in _RATED)


def _compare(
    outcome: Outcome, entries: list[Entry], recorded: dict[str, Recorded], excused: set[str]
) -> None:
    """Judge what was recorded; of excused episodes only that it can be read, and holds nothing twice."""
    outcome.unreadable += recorded.get("", Recorded()).unfinished
    for episode in dict.fromkeys(one.episode for one in entries if one.episode != NO_EPISODE):
        of_it = recorded.get(episode, Recorded(unfinished=[f"{episode} (nothing)"]))
        missing = lost([one for one in entries if one.episode == episode], of_it)
        outcome.recorded += len(of_it.places)
        outcome.duplicates += of_it.duplicates
        outcome.unreadable += of_it.unfinished
        outcome.unsaid |= _of_episode(episode, unsaid(missing, of_it))
        if episode not in excused:
            outcome.lost_ticks += len(set().union(*missing.values()))
            outcome.lost |= _of_episode(episode, missing)


def _of_episode(episode: str, ticks: dict[str, list[int]]) -> dict[str, list[int]]:
    return {f"{episode} {topic}": each for topic, each in ticks.items()}


def verdict(cell: Cell, outcome: Outcome) -> list[str]:
    """Name the limits that were not kept."""
    limits = cell.limits
    still_s = limits.still_s + STEP_S  # what a base's log may be off by
    late = outcome.recovery_s is None or (cell.watched is not None and outcome.restart_s is None)
    found = {
        "found": cell.instances > 1 and outcome.outcomes.keys() != {"found"},
        "stand still": outcome.still_s > still_s,
        "stale": bool(outcome.stale),
        "stand": (cell.stands or cell.abandoned)
        and (outcome.stood_s is None or outcome.stood_s > still_s),
        "drive again": cell.stands and outcome.moved_again_s is None,
        "recovery": limits.recovery_s is not None
        and (late or (outcome.recovery_s or 0.0) > limits.recovery_s),
        "lost": limits.lost_ticks is not None and outcome.lost_ticks > limits.lost_ticks,
        "twice": outcome.duplicates > 0,
        "gap not said": bool(outcome.unsaid),
        "not finished": bool(outcome.unreadable),
        "pause": limits.pause_s is not None and outcome.pause_s > limits.pause_s,
        "rate": limits.rate_hz is not None and (outcome.rate_hz or 0.0) < limits.rate_hz,
    }
    return [name for name, failed in found.items() if failed]

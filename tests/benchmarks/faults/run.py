"""Running one cell on a rig, and judging what the observer and the recorder have of it."""

from __future__ import annotations

import os
import time
from dataclasses import dataclass, field
from typing import Any, Final, Self

from schemas.topics import COMMANDS, JPEG, OBSERVATION, POSE, STATE
from tests.benchmarks.faults import judge
from tests.benchmarks.faults.cells import Cell
from tests.benchmarks.faults.judge import Window
from tests.benchmarks.faults.log import Step
from tests.benchmarks.faults.recordings import Recorded, balance, read_recordings
from tests.benchmarks.faults.rig import Rig
from tests.benchmarks.faults.stop import Stop
from tests.benchmarks.faults.track import Track

#: Given up after so long; a renderer that starts anew on a busy machine has taken 50 s.
_RECOVERY_S: Final = 60.0
#: After the recovery the loop goes on for so many answered frames, so that what comes late is seen.
_AFTERWARDS: Final = 15
_RATED: Final = (JPEG.name, POSE.name, OBSERVATION.name, STATE.name, COMMANDS["policy"].name)


@dataclass
class Outcome:
    """What a cell cost.

    Parameters
    ----------
    name : str
    fault : Window
    still : Still
    stood_s, moved_again_s : float, optional
        After the begin and the end of a fault that has to make it stand, by the log of a moving base.
    stale : list of str
        Commands that were obeyed although too old, or though nobody gave them.
    refused : int
        Commands that the actuator refused, as stale for instance.
    recovery_s, restart_s : float, optional
        Until the loop worked again, and until the killed process's successor was ready.
    pause_s : float
        The longest time without a new command, from the begin of the fault to the recovery.
    rate_hz : float, optional
        Of the slowest topic during the fault, where that is limited.
    load : float
        Load average of the machine: above its number of cores others were waiting, and times say little.
    lost, unsaid : dict of str to list of int
        See ``Balance``, by episode and topic.
    lost_ticks, duplicates, recorded : int
        Over all episodes of the cell.
    stops : list of Stop
        Emergency stops that were sent while the bus was flooded.
    """

    name: str
    fault: Window
    still: judge.Still = field(default_factory=judge.Still)
    stood_s: float | None = None
    moved_again_s: float | None = None
    stale: list[str] = field(default_factory=list)
    refused: int = 0
    recovery_s: float | None = None
    restart_s: float | None = None
    pause_s: float = 0.0
    rate_hz: float | None = None
    load: float = 0.0
    lost_ticks: int = 0
    lost: dict[str, list[int]] = field(default_factory=dict)
    unsaid: dict[str, list[int]] = field(default_factory=dict)
    duplicates: int = 0
    recorded: int = 0
    unreadable: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    not_met: list[str] = field(default_factory=list)
    tracks: list[Track] = field(default_factory=list)
    steps: list[Step] = field(default_factory=list)
    did_not_run: bool = False
    stops: list[Stop] = field(default_factory=list)

    @classmethod
    def failed(cls, name: str, reason: str) -> Self:
        """Return what there is to say of a cell that could not be run."""
        return cls(name, Window(0.0, 0.0), notes=[reason], not_met=["did not run"], did_not_run=True)

    def record(self) -> dict[str, Any]:
        """Return what JSON is to hold."""
        own = {
            name: value
            for name, value in vars(self).items()
            if name not in ("tracks", "steps", "fault", "still", "stops")
        }
        own |= {"still_s": self.still.at_most_s, "still_at_least_s": self.still.at_least_s}
        own["stops"] = [vars(stop) for stop in self.stops]
        return own | {"fault_s": self.fault.end_s - self.fault.begin_s, "met": not self.not_met}


def run_cell(cell: Cell, rig: Rig) -> Outcome:
    """Do the harm while the robot drives, wait for the recovery, and judge."""
    if rig.plan.flooded:
        return _run_flooded(cell, rig)
    rig.start_moving()
    watched = rig.pid(cell.watched) if cell.watched else 0
    rig.driven = cell.drives_on
    outcome = Outcome(cell.name, cell.harm(rig))
    rig.driven = True
    if cell.watched is not None:
        outcome.restart_s = _restarted(rig, cell.watched, watched, outcome.fault.end_s)
    _recover(rig, outcome.fault.end_s)
    over_s = time.monotonic()
    harmed = {track.episode for track in rig.tracks()}
    rig.finish_episode()
    if cell.next_episode:
        entries, notes = rig.entries, rig.notes
        rig.start_moving()
        rig.finish_episode()
        rig.entries, rig.notes = entries + rig.entries, notes + rig.notes
    _judge(cell, outcome, rig.tracks(), over_s)
    if rig.plan.rolling:
        _judge_base(cell, outcome, rig.steps())
    _compare(outcome, read_recordings(rig.plan.recordings), harmed if cell.next_episode else set())
    outcome.notes, outcome.load = rig.notes, os.getloadavg()[0]
    outcome.not_met = verdict(cell, outcome)
    return outcome


def _run_flooded(cell: Cell, rig: Rig) -> Outcome:
    """Judge the stops alone: nobody observes a flooded bus."""
    outcome = Outcome(cell.name, cell.harm(rig))
    outcome.stops, outcome.notes, outcome.load = rig.stops, rig.notes, os.getloadavg()[0]
    outcome.not_met = [] if all(stop.in_time for stop in outcome.stops) else ["stops"]
    return outcome


def _restarted(rig: Rig, service: str, dead: int, since_s: float) -> float | None:
    if rig.until(lambda: rig.ready(service, not_pid=dead), _RECOVERY_S):
        return time.monotonic() - since_s
    return None


def _recover(rig: Rig, since_s: float) -> None:
    """Wait until the loop works, or does not in any reasonable time."""
    rig.until(lambda: judge.flows(rig.tracks(), since_s, _AFTERWARDS), _RECOVERY_S)


def _judge(cell: Cell, outcome: Outcome, seen: list[Track], over_s: float) -> None:
    """Judge what the robot did."""
    fault = outcome.fault
    outcome.tracks = seen
    for track in seen:
        outcome.still = outcome.still.worst(judge.stand_still(track, fault))
    outcome.stale = [one for track in seen for one in judge.stale(track)]
    outcome.refused = sum(judge.refused(track) for track in seen)
    outcome.recovery_s = judge.recovery_s(seen, fault.end_s)
    back_s = fault.end_s + outcome.recovery_s if outcome.recovery_s is not None else over_s
    outcome.pause_s = judge.longest_pause_s(seen, Window(fault.begin_s - 0.5, back_s))
    if cell.limits.rate_hz is not None:
        outcome.rate_hz = min(judge.rate_hz(seen, topic, fault) for topic in _RATED)


def _judge_base(cell: Cell, outcome: Outcome, steps: list[Step]) -> None:
    """Judge what the robot did by what its base did, in place of the poses that it told."""
    asked = judge.commands(outcome.tracks)
    outcome.steps = steps
    outcome.still = judge.rolled_on(steps, asked)
    outcome.stale += judge.stale_orders(steps, asked)
    if cell.stands:
        outcome.stood_s, outcome.moved_again_s = judge.stood_s(steps, outcome.fault)
    elif cell.abandoned:
        outcome.stood_s = judge.moved_on_s(steps, outcome.fault)


def _compare(outcome: Outcome, recorded: dict[str, Recorded], excused: set[str]) -> None:
    """Judge what was recorded; of excused episodes only that it can be read, and holds nothing twice."""
    for track in outcome.tracks:
        of_it = recorded.get(track.episode, Recorded())
        balanced = balance(track, of_it)
        outcome.recorded += len(of_it.places)
        outcome.duplicates += balanced.duplicates
        outcome.unreadable += of_it.unfinished or ([] if of_it.files else [f"{track.episode} (nothing)"])
        if track.episode not in excused:
            outcome.lost_ticks += balanced.lost_ticks
            outcome.lost |= {f"{track.episode} {topic}": ticks for topic, ticks in balanced.lost.items()}
        outcome.unsaid |= {f"{track.episode} {topic}": ticks for topic, ticks in balanced.unsaid.items()}


def verdict(cell: Cell, outcome: Outcome) -> list[str]:
    """Name the limits that were not kept."""
    limits = cell.limits
    still_s = limits.still_s + judge.RESOLUTION_S
    back_s = [outcome.recovery_s, *([outcome.restart_s] if cell.watched else [])]
    found = {
        "stand still": outcome.still.at_least_s > still_s,
        "stand still (not sure)": outcome.still.at_least_s <= still_s < outcome.still.at_most_s,
        "stale": bool(outcome.stale),
        "recovery": limits.recovery_s is not None and any(one is None for one in back_s),
        "lost": limits.lost_ticks is not None and outcome.lost_ticks > limits.lost_ticks,
        "twice": outcome.duplicates > 0,
        "gap not said": bool(outcome.unsaid),
        "not finished": bool(outcome.unreadable),
        "pause": limits.pause_s is not None and outcome.pause_s > limits.pause_s,
        "rate": limits.rate_hz is not None and (outcome.rate_hz or 0.0) < limits.rate_hz,
    }
    if cell.stands or cell.abandoned:
        found["stand"] = outcome.stood_s is None or outcome.stood_s > still_s
    if cell.stands:
        found["drive again"] = outcome.moved_again_s is None
    if limits.recovery_s is not None and outcome.recovery_s is not None:
        found["recovery"] |= outcome.recovery_s > limits.recovery_s
    return [name for name, failed in found.items() if failed]

"""Faults: what kill -9, freezes, outages, a full disk, a jumping clock, a slow consumer and floods cost.

A whole stack of processes drives a robot in real time. Each cell does one harm while the robot moves, and is judged by
the log of an observer, a process of its own, and by the recordings; where the base moves, by that process's log too.
Columns: how long the robot moved after its last valid command (to 0.02 s, and at most so long: on a busy machine the
true time may be shorter); how long a moving base went on after the begin of the fault; commands obeyed although too
old, or that nobody gave; seconds from the end of the fault to the next frame that the loop answers; seconds until the
successor of a killed process is ready; the longest time without a new command; frames of which a message is not
recorded; messages recorded twice; the machine's load, which above its number of cores makes times long.

The cells "floods" and "floods with certificates" flood each key and call of each role in turn as fast as Zenoh takes
it, by one process. In each flood one emergency stop is put, a single time (the stop's own key is not flooded: whatever
comes on it stops the robot). Two columns: how many stops the robot stood for within 0.5 s of the put, by a note of its
own process, and the longest time that it took.
"""

from __future__ import annotations

import itertools
import sys
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

from tqdm import tqdm

from services.cli import certificates, options
from services.kit.errors import JobError, UsageError
from tests.benchmarks.command_line import Parser, folder_for, say
from tests.benchmarks.faults.cells import LINKED, MATRIX, QUICK, Bench, Cell
from tests.benchmarks.faults.harm import FAKETIME, clock_environment
from tests.benchmarks.faults.model import taught_model
from tests.benchmarks.faults.picture import draw
from tests.benchmarks.faults.rig import ROBOT, RigPlan, rig_for
from tests.benchmarks.faults.run import Outcome, run_cell
from tests.benchmarks.faults.stop import Stop
from tests.benchmarks.machine import machine
from tests.benchmarks.results import Record, table

_BENCHES: Final[tuple[Bench, ...]] = ("plain", "linked", "rolling", "clock", "flooded", "guarded")
_NO_CLOCK: Final = "libfaketime is not installed (apt-get install libfaketime)"


def benchmark(cells: Sequence[Cell], model: Path | None, folder: Path, pictures: Path | None) -> dict[str, Any]:
    """Run cells; return what the JSON file holds."""
    left_out = {cell.name: _NO_CLOCK for cell in cells if cell.bench == "clock" and not FAKETIME}
    cells = [cell for cell in cells if cell.name not in left_out]
    outcomes: list[Outcome] = []
    model = model or taught_model(folder / "taught")
    with tqdm(total=len(cells), desc="faults", unit="cell", dynamic_ncols=True) as bar:
        for bench in _BENCHES:
            chosen = [cell for cell in cells if cell.bench == bench]
            for outcome in _run(chosen, _plan(bench, model, folder), bar) if chosen else ():
                outcomes.append(outcome)
                if pictures is not None and not outcome.did_not_run:
                    draw(outcome, pictures / f"{outcome.name.replace(' ', '-')}.png")
    return {
        "benchmark": "faults",
        "machine": machine(),
        "cells": [outcome.record() for outcome in outcomes],
        "left_out": left_out,
        "met": sum(not outcome.not_met for outcome in outcomes),
        "not_met": {outcome.name: outcome.not_met for outcome in outcomes if outcome.not_met},
    }


def _plan(bench: Bench, model: Path, folder: Path) -> RigPlan:
    own = folder / bench
    own.mkdir(parents=True, exist_ok=True)
    environment = clock_environment(own / "clock") if bench == "clock" else {}
    linked = {"linked": LINKED, "rolling": LINKED}.get(bench, ())
    flooded = bench in ("flooded", "guarded")
    secure = own / "keys" if bench == "guarded" else None
    if secure is not None:
        certificates.begin(secure, ROBOT)
        certificates.issue(secure, certificates.HOSTS)
    return RigPlan(model, own, linked, environment, rolling=bench == "rolling", flooded=flooded, secure=secure)


def _run(cells: Sequence[Cell], plan: RigPlan, bar: tqdm[Any]) -> Iterator[Outcome]:
    """Run cells one after the other on a stack; one that does not drive any more is replaced by a new one."""
    waiting = list(cells)
    for number in itertools.count(1):
        if not waiting:
            return
        bar.set_postfix_str("starting a stack")
        with rig_for(replace(plan, folder=plan.folder / f"stack{number}")) as rig:
            before = len(waiting)
            while waiting:
                bar.set_postfix_str(waiting[0].name)
                try:
                    outcome = run_cell(waiting[0], rig)
                except JobError as error:
                    if len(waiting) < before:
                        tqdm.write(f"{waiting[0].name}: {error}; again with a new stack", sys.stderr)
                        break
                    outcome = Outcome.failed(waiting[0].name, str(error))
                tqdm.write(f"{outcome.name}: {', '.join(outcome.not_met) or 'met'}", sys.stderr)
                yield outcome
                waiting.pop(0)
                bar.update()
                if outcome.did_not_run:
                    break


def as_text(results: dict[str, Any]) -> str:
    """Lay the results out for a reader."""
    text = table("faults", [_row(one) for one in results["cells"]])
    for name, reason in results["left_out"].items():
        text += f"left out: {name}: {reason}\n"
    return text + f"\n{results['met']} of {len(results['cells'])} cells met\n"


def _row(one: dict[str, Any]) -> Record:
    return {
        "cell": one["name"],
        "still s": round(one["still_s"], 3),
        "stood s": one["stood_s"],
        "stale": len(one["stale"]),
        "recovery s": one["recovery_s"],
        "restart s": one["restart_s"],
        "pause s": one["pause_s"],
        "rate Hz": one["rate_hz"],
        "lost frames": one["lost_ticks"],
        "twice": one["duplicates"],
        "stops": _stops(one["stops"]),
        "latest s": max((stop["late_s"] for stop in one["stops"] if stop["late_s"] is not None), default=None),
        "load": round(one["load"], 1),
        "": "met" if one["met"] else f"NOT MET: {', '.join(one['not_met'])}",
    }


def _stops(stops: list[dict[str, Any]]) -> str:
    return f"{sum(Stop(**stop).in_time for stop in stops)} of {len(stops)}" if stops else "-"


def main(arguments: list[str]) -> None:
    """Read the flags, run the matrix, print and write."""
    chosen = _parser().parse(arguments)
    if chosen.model is not None:
        options.read_model(chosen.model, "filter", None)
    with folder_for(chosen.out) as folder:
        results = benchmark(_cells(chosen.cell, quick=chosen.quick), chosen.model, folder, chosen.out)
    say(chosen, results, as_text(results))


def _cells(names: Sequence[str], *, quick: bool) -> list[Cell]:
    known = {cell.name: cell for cell in MATRIX}
    wrong = [name for name in names if name not in known]
    if wrong:
        raise UsageError(f"no cell {wrong[0]!r}; known are: {', '.join(known)}")
    names = names or (QUICK if quick else tuple(known))
    return [known[name] for name in names]


def _parser() -> Parser:
    parser = Parser("faults", __doc__)
    parser.add_model()
    parser.add_argument("--cell", action="append", default=[], metavar="NAME", help="only this cell; may be repeated")
    return parser

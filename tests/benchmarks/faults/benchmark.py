"""Faults: what kill -9, freezes, outages, a full disk, a slow consumer and floods cost.

A whole stack of processes drives a robot in real time, whose base is a process of its own that moves on whatever is
harmed. Each cell does one harm while the robot moves, and is judged by that base's log, by what is observed on the bus
and by the recordings. Columns: how long the base moved after the last valid command for it; how long after the begin of
the fault it stood; orders obeyed although too old, or that nobody gave; seconds from the end of the fault to the next
frame that the loop answers; seconds until the successor of a killed process is ready; the longest time without a new
command; frames of which a message is not recorded; messages recorded twice; the machine's load, which above its number
of cores makes times long.

The cells "floods" and "floods with certificates" flood each key and call of each role in turn as fast as Zenoh takes
it, by one process. In each flood one emergency stop is put, a single time (the stop's own key is not flooded: whatever
comes on it stops the robot): how many stops the robot stood for within 0.5 s of the put, by a note of its own process,
and the longest time that it took. It may have stood already for another reason: deaf lanes, or commands that are late.
The cells "floods of declarations" and "floods of declarations with certificates" do so 100 times in each flood of
tokens, subscribers and queryables.
"""

import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from statistics import median
from typing import Any

from tqdm import tqdm

from services.cli import options
from services.kit.errors import JobError, UsageError
from tests.benchmarks.drives import taught
from tests.benchmarks.faults.cells import FLOODS, MATRIX, QUICK, Cell
from tests.benchmarks.faults.floods import Stop, declared, flooded, floods
from tests.benchmarks.faults.rig import CAMERA, ROBOT, WORLD, RigPlan, rig_for
from tests.benchmarks.faults.run import Outcome, run_cell
from tests.benchmarks.reporting import Parser, Record, folder_for, say, table
from tests.services.secured import make_keys


def taught_model(folder: Path) -> Path:
    """Teach a robot the small world in which it is disturbed; what was taught before into the folder is used."""
    return taught(folder, 1, 0, WORLD, f"{CAMERA[0]}x{CAMERA[1]}")


def benchmark(names: Sequence[str], model: Path | None, folder: Path) -> dict[str, Any]:
    """Run cells; return what the JSON file holds."""
    model = model or taught_model(folder / "taught")
    outcomes = list(_run([MATRIX[name] for name in names if name in MATRIX], model, folder))
    stops = {
        name: _stops(name, model, folder / name.replace(" ", "-"))
        for name in names
        if name in FLOODS
    }
    not_met = {one.name: one.not_met for one in outcomes if one.not_met}
    not_met |= {
        name: ["stops"] for name, each in stops.items() if not all(stop.in_time for stop in each)
    }
    return {
        "benchmark": "faults",
        "cells": [outcome.record() for outcome in outcomes],
        "floods": {name: [vars(stop) for stop in each] for name, each in stops.items()},
        "met": len(names) - len(not_met),
        "not_met": not_met,
    }


def _stops(name: str, model: Path, folder: Path) -> list[Stop]:
    folder.mkdir(parents=True, exist_ok=True)
    keys = make_keys(folder / "keys", robot=ROBOT) if name.endswith("with certificates") else None
    found = declared if "declarations" in name else floods
    with rig_for(RigPlan(model, folder, robot="noting", secure=keys)) as rig:
        return flooded(rig, found(keys is not None))


def _run(cells: Sequence[Cell], model: Path, folder: Path) -> Iterator[Outcome]:
    """Run cells one after the other on a stack; one that does not drive any more is replaced by a new one, once."""
    waiting = list(cells)
    stacks = 0
    retried = ""
    with tqdm(total=len(waiting), desc="faults", unit="cell", dynamic_ncols=True) as bar:
        while waiting:
            stacks += 1
            kind = (waiting[0].routers, waiting[0].instances)
            routers, instances = kind
            plan = RigPlan(
                model,
                folder / f"stack{stacks}",
                routers=routers,
                robots=instances,
                instances=instances,
            )
            with rig_for(plan) as rig:
                while waiting and (waiting[0].routers, waiting[0].instances) == kind:
                    name = waiting[0].name
                    bar.set_postfix_str(name)
                    try:
                        outcome = run_cell(waiting[0], rig)
                    except JobError as error:
                        if retried != name:
                            tqdm.write(f"{name}: {error}; again with a new stack", sys.stderr)
                            retried = name
                            break
                        outcome = Outcome(name, notes=[str(error)], not_met=["did not run"])
                    tqdm.write(f"{name}: {', '.join(outcome.not_met) or 'met'}", sys.stderr)
                    yield outcome
                    waiting.pop(0)
                    bar.update()


def as_text(results: dict[str, Any]) -> str:
    """Lay the results out for a reader."""
    columns = (
        "still_s",
        "stood_s",
        "recovery_s",
        "restart_s",
        "pause_s",
        "rate_hz",
        "lost_ticks",
        "duplicates",
        "load",
    )
    rows: list[Record] = [
        {"cell": one["name"], "stale": len(one["stale"])} | {name: one[name] for name in columns}
        | {"": "met" if one["met"] else f"NOT MET: {', '.join(one['not_met'])}"} for one in results["cells"]
    ]  # fmt: skip
    text = table("faults", rows)
    for name in dict.fromkeys(one["name"] for one in results["cells"]):
        pauses = [one["pause_s"] for one in results["cells"] if one["name"] == name]
        if len(pauses) > 1:
            told = f"{len(pauses)} times, without a command for {median(pauses):.2f} s, at most {max(pauses):.2f} s"
            text += f"\n{name}: {told}\n"
    for name, each in results["floods"].items():
        stops = [Stop(**stop) for stop in each]
        latest_s = max((stop.late_s for stop in stops if stop.late_s is not None), default=None)
        text += f"\n{name}: {sum(stop.in_time for stop in stops)} of {len(stops)} stops in time, at most {latest_s} s\n"
    return text + f"\n{results['met']} met, {len(results['not_met'])} not\n"


def main(arguments: list[str]) -> None:
    """Read the flags, run the matrix, print and write."""
    parser = Parser("faults", __doc__)
    parser.add_model()
    parser.add_argument(
        "--cell",
        action="append",
        default=[],
        metavar="NAME",
        help="only this cell; may be repeated",
    )
    parser.add_argument(
        "--times", type=int, default=1, metavar="N", help="how often each cell, one after another"
    )
    chosen = parser.parse(arguments)
    known = (*MATRIX, *FLOODS)
    wrong = [name for name in chosen.cell if name not in known]
    if wrong:
        raise UsageError(f"no cell {wrong[0]!r}; known are: {', '.join(known)}")
    if chosen.model is not None:
        options.read_model(chosen.model, options.Use("filter"))
    with folder_for(chosen.out) as folder:
        names = chosen.cell or (QUICK if chosen.quick else known)
        results = benchmark(
            [name for name in names for _ in range(chosen.times)], chosen.model, folder
        )
    say(chosen, results, as_text(results))

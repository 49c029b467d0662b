"""Recorder: what its process holds while one drive of hours is recorded, with a clock that runs faster.

Every message of a tick is handed to the recorder as it would come from the bus, 10 ticks a second of the drive's own
time. Memory may grow by less than 5 % after a tenth of the drive, by a straight line through the samples.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

from mcap.reader import make_reader
from tqdm import tqdm

from services.cli.stack.processes import free_endpoint
from services.kit.bus import Router
from services.kit.errors import JobError
from services.kit.node import Node
from services.kit.settings import ServiceSettings
from services.recorder.service import RecorderService
from services.robot.clock import TICK_S
from tests.benchmarks.command_line import Parser, folder_for, say
from tests.benchmarks.machine import machine
from tests.benchmarks.results import Record, table
from tests.benchmarks.soak.growth import Sample, judge, sample
from tests.services.recordings.recorded_messages import applied, event, frame, header

_HOURS: Final = 4.0
_QUICK_HOURS: Final = 0.25
_SAMPLES: Final = 60
#: What comes with no frame but the first of a drive.
_ONCE: Final = ("camera/info", "map")
#: A person drives, and nobody else.
_OTHERS: Final = ("command/emergency_stop", "command/expert", "command/policy")


def benchmark(hours: float, folder: Path) -> dict[str, Any]:
    """Record one drive; return what the JSON file holds."""
    ticks = round(hours * 3600 / TICK_S)
    endpoint = free_endpoint()
    router = Router(endpoint)
    try:
        with Node("recorder", ServiceSettings(robot="rescuebot", router=endpoint)) as node:
            recorder = RecorderService(node, folder, folder)
            began_s = time.monotonic()
            samples = list(_samples(recorder, ticks))
            sealing_s = time.monotonic()
            recorder.close()
            ended_s = time.monotonic()
            messages = recorder.detail()["messages"]
    finally:
        router.close()
    (path,) = folder.iterdir()
    (judged,) = judge(samples)
    return {
        "benchmark": "recorder",
        "machine": machine(),
        "hours": hours,
        "messages": messages,
        "seconds": sealing_s - began_s,
        "sealing_s": ended_s - sealing_s,
        "sealed_rss_mb": sample(0.0, "recorder", os.getpid()).rss_bytes / 1e6,
        "file": _file(path),
        "memory": judged,
        "samples": [vars(one) for one in samples],
        "met": judged[""] == "met",
    }


def _samples(recorder: RecorderService, ticks: int) -> Iterator[Sample]:
    """Have the recorder take a drive, and look at this process now and then, by the drive's own time."""
    first = [event("long", 0, "started"), *frame("long", 0), applied("long", 0, sequence=0)]
    always = [one for one in first if one.topic_name not in ("episode", *_ONCE, *_OTHERS)]
    for message in first:
        recorder.handle(message)
    for tick in tqdm(range(1, ticks), desc="recording", unit="tick", dynamic_ncols=True):
        told = {"tick": tick, "stamp_ns": header("long", tick).stamp_ns}
        for message in always:
            recorder.handle(message.model_copy(update=told))
        if tick % (ticks // _SAMPLES) == 0:
            yield sample(tick * TICK_S, "recorder", os.getpid())


def _file(path: Path) -> Record:
    """Tell what viewers have to hold of it, and that they can open it."""
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    if summary is None or summary.statistics is None:
        raise JobError(f"{path}: viewers cannot seek in it")
    return {
        "name": path.name,
        "mb": path.stat().st_size / 1e6,
        "messages": summary.statistics.message_count,
        "chunks": len(summary.chunk_indexes),
    }


def as_text(results: dict[str, Any]) -> str:
    """Lay the results out for a reader."""
    rows: list[Record] = [
        {"hours of the drive": one["t_s"] / 3600.0, "MB": one["rss_bytes"] / 1e6} for one in results["samples"]
    ]
    text = table("memory of the recorder", rows[:: max(1, len(rows) // 12)])
    text += table("after a tenth of the drive", [results["memory"]]) + table("the file", [results["file"]])
    text += f"\n{results['hours']:g} hours, {results['messages']:,} messages in {results['seconds']:.0f} s; "
    text += f"sealed in {results['sealing_s']:.1f} s, then {results['sealed_rss_mb']:.0f} MB; "
    return text + f"{'met' if results['met'] else 'NOT MET'}\n"


def main(arguments: list[str]) -> None:
    """Read the flags, record, print and write."""
    parser = Parser("recorder", __doc__)
    parser.add_argument("--hours", type=_hours, metavar="H", help=f"how long the drive is (default {_HOURS:g})")
    chosen = parser.parse(arguments)
    with folder_for(chosen.out) as folder:
        own = folder / "recorder"
        own.mkdir(parents=True, exist_ok=True)
        results = benchmark(chosen.hours or (_QUICK_HOURS if chosen.quick else _HOURS), own)
    say(chosen, results, as_text(results))
    if not results["met"]:
        raise JobError("the recorder's memory grows")


def _hours(text: str) -> float:
    hours = float(text)
    if not 0.0 < hours <= 24.0:
        raise argparse.ArgumentTypeError("more than 0, at most 24")
    return hours

"""Soak: what the services hold while the robot drives for an hour, episode after episode, in real time.

Memory may grow by less than 5 % after a warm-up (a tenth of the run, at least two minutes), by a straight line through
the samples; descriptors and threads must not become more. With --robots N so many robots share features, recognition,
policy and tracker, in lockstep, so that a machine which is too small for them takes longer and no frame is lost.

With --page a browser watches the console's page, for ten minutes. What the page holds after a collection of garbage is
looked at once a minute: after the warm-up it may grow by 0.5 MB, of the 25 MB of pictures that it is sent, and by the
lines of its news; its listeners must not become more. Needs Debian's Chromium.
"""

import argparse
import json
import shutil
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import nullcontext, suppress
from pathlib import Path
from typing import Any, Final

from tqdm import tqdm

from services.cli import options
from services.cli.stack import free_endpoint
from services.kit.errors import JobError
from services.kit.settings import MAX_ROBOTS
from services.table import stack_services
from tests.benchmarks.faults.benchmark import taught_model
from tests.benchmarks.faults.rig import Rig, RigPlan, rig_for
from tests.benchmarks.reporting import Parser, Record, folder_for, say, table
from tests.benchmarks.soak.growth import Sample, judge, sample, warmed_up
from tests.benchmarks.soak.page import CHROMIUM, NO_CHROMIUM, Held, Send, held, judge_page, page_of

_MINUTES: Final = 60.0
_PAGE_MINUTES: Final = 10.0
_QUICK_MINUTES: Final = 1.0
_PERIOD_S: Final = 10.0
_SAMPLES: Final = 30
_PAGE_PERIOD_S: Final = 60.0
_PAGE_SAMPLES: Final = 10
_KEPT: Final = 5  # Recordings that are kept: an hour's would be gigabytes.
_LEAST_HZ: Final = 8.0  # Fewer commands a second: the loop stood, and the run says nothing.
_LEAST_LOCKSTEP_HZ: Final = (
    1.0  # So in lockstep, of all robots together, on a machine that is busy otherwise.
)
_BAR: Final = "{l_bar}{bar}| {elapsed}<{remaining}{postfix}"


def benchmark(
    minutes: float, model: Path | None, folder: Path, *, page: bool, robots: int = 1
) -> dict[str, Any]:
    """Let robots drive, and have a page watch the first or not; return what the JSON file holds."""
    model = model or taught_model(folder / "taught")
    address = free_endpoint().removeprefix("tcp/")
    browser = page_of(f"http://{address}/") if page else nullcontext()
    pages: list[Held] = []
    own = folder / "soak"
    # The console draws what lies below its root.
    own.mkdir(parents=True, exist_ok=True)
    model = Path(shutil.copy(model, own / "model.smal"))
    mode, least_hz = ("realtime", _LEAST_HZ) if robots == 1 else ("lockstep", _LEAST_LOCKSTEP_HZ)
    plan = RigPlan(model, own, robot="simulated", console=address, robots=robots, mode=mode)
    outcomes: Counter[str] = Counter()
    with rig_for(plan) as rig, browser as send:
        rig.start_moving()
        rig.driven = True
        samples = list(
            _samples(rig, minutes * 60.0, folder / "samples.jsonl", send, pages, outcomes)
        )
        messages = [
            _messages(one, service) for one in (rig, *rig.others) for service in stack_services()
        ]
        rig.finish_episode()
    services = judge(samples)
    judged = [judge_page(warmed_up(pages))] if page else []
    rate_hz = sum(int(one["commands"]) for one in messages if one["service"] == "policy") / (
        minutes * 60.0
    )
    return {
        "benchmark": "soak",
        "minutes": minutes,
        "episodes": dict(outcomes),
        "commands_hz": rate_hz,
        "services": services,
        "messages": messages,
        "samples": [vars(one) for one in samples],
        "pages": judged,
        "page_samples": [vars(one) for one in pages],
        "met": rate_hz >= least_hz and all(one[""] == "met" for one in (*services, *judged)),
    }


def _samples(
    rig: Rig,
    seconds: float,
    log: Path,
    send: Send | None,
    pages: list[Held],
    outcomes: Counter[str],
) -> Iterator[Sample]:
    """Look at every process now and then, and at the page if there is one; what was seen is on the disk at once."""
    period_s = min(_PERIOD_S, seconds / _SAMPLES)
    page_period_s = min(_PAGE_PERIOD_S, seconds / _PAGE_SAMPLES)
    began_s = time.monotonic()
    with (
        log.open("w", buffering=1) as file,
        tqdm(
            total=round(seconds), desc="soaking", unit="s", bar_format=_BAR, dynamic_ncols=True
        ) as bar,
    ):
        due_s = 0.0
        while due_s <= seconds:
            rig.hold(max(0.0, began_s + due_s - time.monotonic()))
            for process in rig.stack.plan.processes():
                with suppress(OSError):  # it has died, and is started again
                    one = sample(time.monotonic() - began_s, process, rig.stack.pid(process))
                    file.write(json.dumps(vars(one)) + "\n")
                    yield one
            if send is not None and due_s >= page_period_s * len(pages):
                pages.append(held(time.monotonic() - began_s, send))
                file.write(json.dumps(vars(pages[-1])) + "\n")
            _remove_old(rig.plan.recordings)
            for each in (rig, *rig.others):
                outcomes.update(each.outcomes)
            rig.forget()
            bar.update(round(due_s) - bar.n)
            bar.set_postfix_str(f"{outcomes.total()} episodes")
            due_s += period_s


def _remove_old(recordings: Path) -> None:
    finished = sorted(recordings.rglob("*.mcap"), key=lambda path: path.stat().st_mtime)
    for path in finished[:-_KEPT]:
        path.unlink()


def _messages(rig: Rig, service: str) -> Record:
    status = rig.status(service)
    told = {"robot": rig.bus.robot, "service": service}
    if status is None:
        return (
            told
            | dict.fromkeys(("received", "published", "commands", "dropped", "bad", "failed"), 0)
            | {"": "silent"}
        )
    return told | {
        "received": sum(status.received.values()),
        "published": sum(status.published.values()),
        "commands": status.published.get("command/policy", 0),
        "dropped": sum(status.dropped.values()),
        "bad": sum(status.bad.values()),
        "failed": status.failed,
        "": "",
    }


def as_text(results: dict[str, Any]) -> str:
    """Lay the results out for a reader."""
    text = table(
        f"{results['minutes']:g} minutes, episodes: {results['episodes']}", results["services"]
    )
    text += table("messages", results["messages"])
    text += table("the page, minute by minute", results["page_samples"]) + table(
        "the page", results["pages"]
    )
    return (
        text
        + f"\n{results['commands_hz']:.1f} commands a second; {'met' if results['met'] else 'NOT MET'}\n"
    )


def main(arguments: list[str]) -> None:
    """Read the flags, drive, print and write."""
    chosen = _parser().parse(arguments)
    if chosen.model is not None:
        options.read_model(chosen.model, options.Use("filter"))
    if chosen.page and CHROMIUM is None:
        raise JobError(NO_CHROMIUM)
    usual = _PAGE_MINUTES if chosen.page else _MINUTES
    minutes = chosen.minutes or (_QUICK_MINUTES if chosen.quick else usual)
    with folder_for(chosen.out) as folder:
        results = benchmark(minutes, chosen.model, folder, page=chosen.page, robots=chosen.robots)
    say(chosen, results, as_text(results))
    if not results["met"]:
        raise JobError("the soak is not met")


def _minutes(text: str) -> float:
    minutes = float(text)
    if not 0.0 < minutes <= 10_000.0:
        raise argparse.ArgumentTypeError("more than 0, at most 10,000")
    return minutes


def _parser() -> Parser:
    parser = Parser("soak", __doc__)
    parser.add_argument("--minutes", type=_minutes, metavar="M", help=f"how long to drive (default {_MINUTES:g}, "
                        f"with --page {_PAGE_MINUTES:g})")  # fmt: skip
    parser.add_argument("--page", action="store_true", help="a browser watches the console's page")
    parser.add_argument(
        "--robots", type=int, choices=range(1, MAX_ROBOTS + 1), default=1, metavar="N"
    )
    parser.add_model()
    return parser

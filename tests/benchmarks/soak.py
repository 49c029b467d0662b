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
import os
import shutil
import signal
import subprocess
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager, nullcontext, suppress
from dataclasses import asdict, dataclass
from http.client import HTTPConnection
from pathlib import Path
from typing import Any, Final

import numpy as np
import psutil
from tqdm import tqdm
from websockets.sync.client import ClientConnection, connect

from services.cli import options
from services.cli.child import tied
from services.cli.stack import free_endpoint
from services.kit.errors import JobError
from services.kit.settings import MAX_ROBOTS
from services.table import stack_services
from tests.benchmarks.faults.benchmark import taught_model
from tests.benchmarks.faults.rig import Rig, RigPlan, rig_for
from tests.benchmarks.reporting import Parser, Record, folder_for, say, table
from tests.chromium import CHROMIUM, FLAGS, NO_CHROMIUM

_HOUR_MIN: Final = 60.0
_PAGE_MIN: Final = 10.0
_QUICK_MIN: Final = 1.0
_PERIOD_S: Final = 10.0  # Between two looks at every process, and at least as many looks:
_SAMPLES: Final = 30
_PAGE_PERIOD_S: Final = 60.0  # The same of the page.
_PAGE_SAMPLES: Final = 10
_KEPT: Final = 5  # Recordings that are kept: an hour's would be gigabytes.
_LEAST_HZ: Final = 8.0  # Fewer commands a second: the loop stood, and the run is no evidence.
_LEAST_LOCKSTEP_HZ: Final = 1.0  # The same in lockstep, of all robots, on a busy machine.
_BAR: Final = "{l_bar}{bar}| {elapsed}<{remaining}{postfix}"
WARM_UP_SHARE: Final = 0.1  # Minimum share of the run in which memory is allocated once.
WARM_UP_S: Final = 120.0
MOST_GROWTH: Final = 0.05
#: Growth of a page, bytes, independent of the time: the browser's own caches and compiled code vary by
#: 200,000, and pictures are 50,000 to 200,000 a second.
MOST_PAGE_GROWTH: Final = 500_000
MOST_NODES: Final = 300  # The news fill up: 50 lines of four nodes each; recordings come and go.
_BROWSER_S: Final = 30.0  # Longest time until a browser starts, and until it answers.

#: Sends a command of Chrome's DevTools Protocol, and returns the answer.
Send = Callable[[str], dict[str, Any]]


@dataclass(frozen=True)
class Sample:
    """What one process held so many seconds after the beginning."""

    t_s: float
    service: str
    pid: int
    rss_bytes: int
    descriptors: int
    threads: int


def sample(t_s: float, service: str, pid: int) -> Sample:
    """Measure a process; psutil.NoSuchProcess if there is none of this id."""
    process = psutil.Process(pid)
    rss_bytes = process.memory_info().rss
    return Sample(t_s, service, pid, rss_bytes, process.num_fds(), process.num_threads())


def warmed_up(samples: Sequence[Any]) -> list[Any]:
    """Return the samples after the warm-up; in a run too short for one, those of the second half."""
    whole_s = max((one.t_s for one in samples), default=0.0)
    warm_s = min(max(WARM_UP_SHARE * whole_s, WARM_UP_S), whole_s / 2.0)
    return [one for one in samples if one.t_s >= warm_s]


def judge(samples: Sequence[Sample]) -> list[Record]:
    """Judge each service by its samples after the warm-up."""
    services = dict.fromkeys(one.service for one in samples)
    return [_judge([one for one in samples if one.service == service]) for service in services]


def _judge(samples: Sequence[Sample]) -> Record:
    warm = warmed_up(samples)
    first, last = line([one.t_s for one in warm], [one.rss_bytes for one in warm])
    descriptors, threads = (
        rise([getattr(one, name) for one in warm]) for name in ("descriptors", "threads")
    )
    restarts = len({one.pid for one in samples}) - 1
    return {
        "service": samples[0].service,
        "rss_mb": warm[-1].rss_bytes / 1e6,
        "growth_percent": 100.0 * (last / first - 1.0),
        "descriptors_rise": descriptors,
        "threads_rise": threads,
        "restarts": restarts,
        "": said(
            memory=last / first - 1.0 >= MOST_GROWTH, descriptors=descriptors > 0, threads=threads > 0,
            restarted=restarts > 0,
        ),
    }  # fmt: skip


def said(**failed: bool) -> str:
    """Name what is not met, if anything."""
    names = [name for name, one in failed.items() if one]
    return f"NOT MET: {', '.join(names)}" if names else "met"


def line(times: Sequence[float], sizes: Sequence[float]) -> tuple[float, float]:
    """Return where a straight line through sizes over time begins and ends."""
    if len(times) < 2:
        return float(sizes[0]), float(sizes[-1])
    slope, at_zero = np.polyfit(times, np.array(sizes, dtype=float), 1)
    return float(at_zero + slope * times[0]), float(at_zero + slope * times[-1])


def rise(counts: Sequence[int]) -> float:
    """Return by how much the median of the last quarter is above that of the first: what comes and goes is no leak."""
    quarter = max(1, len(counts) // 4)
    return float(np.median(counts[-quarter:]) - np.median(counts[:quarter]))


@dataclass(frozen=True)
class Held:
    """What a page held so many seconds after the beginning; bytes of objects, and of arrays."""

    t_s: float
    bytes: int
    nodes: int
    listeners: int


def held(t_s: float, send: Send) -> Held:
    """Have a page's garbage collected, and look at what is left."""
    send("Performance.enable")
    send("HeapProfiler.collectGarbage")
    counts = {one["name"]: one["value"] for one in send("Performance.getMetrics")["metrics"]}
    heap = send("Runtime.getHeapUsage")
    size = int(heap["usedSize"] + heap["backingStorageSize"])
    return Held(t_s, size, int(counts["Nodes"]), int(counts["JSEventListeners"]))


def judge_page(warm: Sequence[Held]) -> Record:
    """Judge a page by its samples after its warm-up."""
    first, last = line([one.t_s for one in warm], [one.bytes for one in warm])
    nodes, listeners = (
        rise([getattr(one, name) for one in warm]) for name in ("nodes", "listeners")
    )
    return {
        "page": "console",
        "growth_kb": (last - first) / 1e3,
        "nodes_rise": nodes,
        "listeners_rise": listeners,
        "": said(
            memory=last - first > MOST_PAGE_GROWTH,
            nodes=nodes > MOST_NODES,
            listeners=listeners > 0,
        ),
    }


@contextmanager
def page_of(address: str) -> Iterator[Send]:
    """Open a page in a browser of its own; give a sender of commands to the page.

    No tool but this sender is attached to the browser: others keep what the page receives.
    JavaScript's heap does not contain the bytes of pictures; so both are measured.
    """
    with tempfile.TemporaryDirectory(prefix="smal-browser-", ignore_cleanup_errors=True) as profile:
        command = (
            CHROMIUM,
            "--headless",
            *FLAGS,
            "--remote-debugging-port=0",
            f"--user-data-dir={profile}",
            address,
        )
        browser = subprocess.Popen(
            tied(*command),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
        try:
            with closing(_connect(Path(profile) / "DevToolsActivePort", address)) as socket:
                yield _sender(socket)
        finally:
            os.killpg(browser.pid, signal.SIGTERM)
            browser.wait()


def _connect(port_file: Path, address: str) -> ClientConnection:
    deadline_s = time.monotonic() + _BROWSER_S
    while time.monotonic() < deadline_s:
        time.sleep(0.1)
        if port_file.exists() and (found := _pages(int(port_file.read_text().split()[0]), address)):
            return connect(found[0], max_size=None)
    raise JobError(f"no browser with {address} after {_BROWSER_S:.0f} s")


def _pages(port: int, address: str) -> list[str]:
    with closing(HTTPConnection("127.0.0.1", port, timeout=_BROWSER_S)) as connection:
        connection.request("GET", "/json")
        pages = json.loads(connection.getresponse().read())
    return [one["webSocketDebuggerUrl"] for one in pages if one["url"].startswith(address)]


def _sender(socket: ClientConnection) -> Send:
    number = 0

    def send(method: str) -> dict[str, Any]:
        nonlocal number
        number += 1
        socket.send(json.dumps({"id": number, "method": method}))
        while (answer := json.loads(socket.recv(_BROWSER_S))).get("id") != number:
            pass  # of something that has happened meanwhile
        if "error" in answer:
            raise JobError(f"the browser refuses {method}: {answer['error']['message']}")
        return dict(answer["result"])

    return send


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
        "samples": [asdict(one) for one in samples],
        "pages": judged,
        "page_samples": [asdict(one) for one in pages],
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
                with suppress(psutil.NoSuchProcess):  # it has died, and is started again
                    one = sample(time.monotonic() - began_s, process, rig.stack.pid(process))
                    file.write(json.dumps(asdict(one)) + "\n")
                    yield one
            if send is not None and due_s >= page_period_s * len(pages):
                pages.append(held(time.monotonic() - began_s, send))
                file.write(json.dumps(asdict(pages[-1])) + "\n")
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
    usual = _PAGE_MIN if chosen.page else _HOUR_MIN
    minutes = chosen.minutes or (_QUICK_MIN if chosen.quick else usual)
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
    parser.add_argument("--minutes", type=_minutes, metavar="M", help=f"how long to drive (default {_HOUR_MIN:g}, "
                        f"with --page {_PAGE_MIN:g})")  # fmt: skip
    parser.add_argument("--page", action="store_true", help="a browser watches the console's page")
    parser.add_argument(
        "--robots", type=int, choices=range(1, MAX_ROBOTS + 1), default=1, metavar="N"
    )
    parser.add_model()
    return parser

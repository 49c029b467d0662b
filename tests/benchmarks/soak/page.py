"""What the console's page holds in a browser that watches, and whether it grows.

JavaScript's heap alone does not tell: the bytes of a picture lie beside it. So both are added, after the browser has
collected its garbage.
"""

import json
import os
import shutil
import signal
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from http.client import HTTPConnection
from pathlib import Path
from typing import Any, Final

from websockets.sync.client import ClientConnection, connect

from services.cli.child import tied
from services.kit.errors import JobError
from tests.benchmarks.reporting import Record
from tests.benchmarks.soak.growth import line, rise, said

CHROMIUM: Final = shutil.which("chromium")
NO_CHROMIUM: Final = "no chromium on this machine (apt-get install chromium)"
FLAGS: Final = (
    "--no-sandbox",
)  # Debian's needs it where it runs as root; nothing but the console's page is opened.
#: However long it watches, bytes: what the browser's own caches and compiled code come and go by is 200,000, and
#: pictures are 50,000 to 200,000 a second.
MOST_GROWTH: Final = 500_000
MOST_NODES: Final = (
    300  # The news fill up, 50 lines of four nodes each, and some recordings of thirty come and go.
)
_STARTING_S: Final = 30.0
_ANSWER_S: Final = 30.0

Send = Callable[
    [str], dict[str, Any]
]  # Sends a command of Chrome's DevTools Protocol, and returns the answer.


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
            memory=last - first > MOST_GROWTH, nodes=nodes > MOST_NODES, listeners=listeners > 0
        ),
    }


@contextmanager
def page_of(address: str) -> Iterator[Send]:
    """Open a page in a browser of its own; give what sends commands to the page.

    No tool is attached but the one that is asked for figures: it keeps nothing of what the page is sent.

    Raises
    ------
    JobError
        There is no browser, or it does not start.
    """
    if CHROMIUM is None:
        raise JobError(NO_CHROMIUM)
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
    deadline_s = time.monotonic() + _STARTING_S
    while time.monotonic() < deadline_s:
        time.sleep(0.1)
        if port_file.exists() and (found := _pages(int(port_file.read_text().split()[0]), address)):
            return connect(found[0], max_size=None)
    raise JobError(f"no browser with {address} after {_STARTING_S:.0f} s")


def _pages(port: int, address: str) -> list[str]:
    with closing(HTTPConnection("127.0.0.1", port, timeout=_ANSWER_S)) as connection:
        connection.request("GET", "/json")
        pages = json.loads(connection.getresponse().read())
    return [one["webSocketDebuggerUrl"] for one in pages if one["url"].startswith(address)]


def _sender(socket: ClientConnection) -> Send:
    number = 0

    def send(method: str) -> dict[str, Any]:
        nonlocal number
        number += 1
        socket.send(json.dumps({"id": number, "method": method}))
        while (answer := json.loads(socket.recv(_ANSWER_S))).get("id") != number:
            pass  # of something that has happened meanwhile
        if "error" in answer:
            raise JobError(f"the browser refuses {method}: {answer['error']['message']}")
        return dict(answer["result"])

    return send

"""A service that cannot go on ends soon, with one line, by itself."""

import signal
import subprocess
import sys
from pathlib import Path

import pytest

from schemas.command import Command
from services.kit.bus import Bus
from tests.services.waiting import eventually

ROOT = Path(__file__).parents[3]
NO_MEMORY = "out of memory; this process ends and must be started again"
_SERVICE = """
import threading
from schemas import topics
from schemas.rpc import Nothing
from services.kit.process import run_node
from services.kit.settings import ServiceSettings

def allocate(*_):
    return bytearray(1 << 62)

def fail():
    raise KeyError("a bug")

def serve(node, settings):
    {does}
    node.spin()

run_node("sample", ServiceSettings, serve)
"""


def ended(router: str, does: str) -> tuple[int, list[str]]:
    """Run a service that executes a statement first; return its status and its log."""
    command = [sys.executable, "-c", _SERVICE.format(does=does), "--router", router]
    done = subprocess.run(
        command, cwd=ROOT, stderr=subprocess.PIPE, text=True, timeout=100.0, check=False
    )
    return done.returncode, done.stderr.splitlines()


@pytest.mark.zenoh
@pytest.mark.parametrize(
    "does",
    [
        "node.every(0.01, allocate)",
        "node.apart(0.01, allocate)",
        "threading.Thread(target=allocate).start()",
        "allocate()",
    ],
    ids=["its loop", "work apart", "a thread", "its beginning"],
)
def test_process_ends_with_one_line_when_it_lacks_memory(router_endpoint: str, does: str) -> None:
    status, lines = ended(router_endpoint, does)
    assert (status, len(lines)) == (1, 1), lines
    assert lines[0].endswith(f" sample: {NO_MEMORY}")


@pytest.mark.zenoh
@pytest.mark.parametrize(
    "how", ["node.at_once(STOP, allocate)", "node.bus.subscribe(STOP, allocate)"]
)
def test_process_ends_when_a_callback_lacks_memory(
    router_endpoint: str, client: Bus, how: str
) -> None:
    does = how.replace("STOP", "topics.COMMANDS['emergency_stop']")
    command = [sys.executable, "-c", _SERVICE.format(does=does), "--router", router_endpoint]
    stop = Command(
        robot="rescuebot", episode="e", tick=0, stamp_ns=0, source="emergency_stop", atom="stop"
    )
    with subprocess.Popen(command, cwd=ROOT, stderr=subprocess.PIPE, text=True) as process:

        def has_ended() -> bool:
            client.publish(stop)
            return process.poll() is not None

        eventually(has_ended)
        lines = process.stderr.read().splitlines()
    assert (process.returncode, len(lines)) == (1, 1), lines
    assert lines[0].endswith(f" sample: {NO_MEMORY}")


@pytest.mark.zenoh
def test_process_ends_when_one_of_its_threads_fails(router_endpoint: str) -> None:
    status, lines = ended(router_endpoint, "threading.Thread(target=fail, name='worker').start()")
    assert status == 1
    assert lines[0].endswith(
        " sample: the thread 'worker' failed; this process ends and must be started again"
    )
    assert lines[-1] == "KeyError: 'a bug'"


@pytest.mark.zenoh
def test_process_is_killed_when_it_cannot_tidy_up(router_endpoint: str) -> None:
    stuck = "node.bus.close = threading.Event().wait; from services.kit import ending; ending._ENDING_S = 1"
    status, lines = ended(router_endpoint, f"{stuck}; node.every(0.01, allocate)")
    assert (status, lines) == (-signal.SIGALRM, [])


def test_process_ends_in_one_line_when_memory_is_scarce() -> None:
    limited = "import resource; resource.setrlimit(resource.RLIMIT_DATA, (90 << 20, 90 << 20)); import services.kit.bus"
    done = subprocess.run(
        [sys.executable, "-c", limited],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=100.0,
        check=False,
    )
    assert (done.returncode, done.stderr.count("\n")) == (1, 1)
    assert done.stderr.startswith("out of memory: less than 150 MB can be used")

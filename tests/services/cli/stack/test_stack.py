"""The processes of a stack: none stays behind, the dead come back, and why one died is said in one line."""

from __future__ import annotations

import logging
import os
import re
import signal
import subprocess
import sys
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import pytest

from schemas.rpc import Nothing, Status
from services.cli.stack import patience
from services.cli.stack.backoff import FIRST_S, LONGEST_S, STEADY_S, Backoff
from services.cli.stack.processes import Stack, StackPlan, flags
from services.kit.bus import Bus
from services.kit.errors import JobError
from tests.services.waiting import eventually, ready

#: What services are that do not start at once.
STARTING = "tests.services.cli.stack.starting"
START = """
import sys
from pathlib import Path
from services.cli.main import main
from services.cli.stack.processes import stack_for
import services.cli.main, time
def work():
    with stack_for(None, ("router", "recorder"), sys.argv[1], {}, logs=Path(sys.argv[2])):
        print("ready", flush=True)
        time.sleep(60)
services.cli.main.app = lambda **_: work()
main()
"""


def processes_of(robot: str) -> set[int]:
    """Return the running processes that were started for a robot, by what a stack puts into their environment."""
    found = set()
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            alive = "\nState:\tZ" not in (folder / "status").read_text()
            if alive and f"SMAL_ROBOT={robot}".encode() in (folder / "environ").read_bytes().split(b"\0"):
                found.add(int(folder.name))
        except OSError:
            pass
    return found


@pytest.fixture
def robot(request: pytest.FixtureRequest) -> str:
    """Name a robot that no other test has."""
    return f"{request.node.name[:20].lower().replace('[', '-')}{os.getpid()}"


def plan(robot: str, endpoint: str, tmp_path: Path, *services: str, **flags_of: tuple[str, ...]) -> StackPlan:
    return StackPlan(("router", *services), robot, endpoint, flags_of, logs=tmp_path / "logs")


def test_stop_leaves_no_child(robot: str, free_endpoint: str, tmp_path: Path) -> None:
    with Stack(plan(robot, free_endpoint, tmp_path, "recorder", "policy")) as stack:
        stack.check()
        assert len(processes_of(robot)) == 3
    assert not processes_of(robot)


def test_a_service_that_cannot_start_is_named_with_its_last_line(
    robot: str, free_endpoint: str, tmp_path: Path
) -> None:
    missing = tmp_path / "none.smal"
    stack = Stack(plan(robot, free_endpoint, tmp_path, "policy", policy=flags(model=missing)))
    with pytest.raises(JobError) as caught, stack:
        pass
    assert str(caught.value) == f"policy: {missing}: cannot be read: No such file or directory"
    assert not processes_of(robot)


def test_a_service_that_starts_slowly_is_waited_for_and_whoever_waits_is_told(
    robot: str, free_endpoint: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """It computes for longer than after which one that does nothing is given up, as one that builds a large world."""
    monkeypatch.setattr(patience, "HANGS_S", 4.0)
    monkeypatch.setattr(patience, "_TELL_S", 0.5)
    slow = replace(plan(robot, free_endpoint, tmp_path, "recorder"), modules={"recorder": f"{STARTING}.computing"})
    with Stack(slow) as stack, closing(Bus(robot, free_endpoint)) as bus:
        stack.check()
        assert ready(bus, "recorder").uptime_s < 60.0
    assert re.search(r"waiting for recorder, \d+ s so far \(computing for a while\)", caplog.text)


def test_a_service_that_hangs_in_starting_is_named(
    robot: str, free_endpoint: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(patience, "HANGS_S", 2.0)
    stuck = replace(plan(robot, free_endpoint, tmp_path, "recorder"), modules={"recorder": f"{STARTING}.hanging"})
    with pytest.raises(JobError) as caught, Stack(stuck):
        pass
    assert re.fullmatch(r"recorder hangs: not ready after \d+ s \(waiting for ever\)", str(caught.value))
    assert not processes_of(robot)


def test_a_dead_service_comes_back_with_its_flags(
    robot: str, free_endpoint: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    folder = tmp_path / "drives"
    settings = plan(robot, free_endpoint, tmp_path, "recorder", recorder=flags(recordings=folder))
    with Stack(settings) as stack, caplog.at_level(logging.WARNING):
        bus = Bus(robot, free_endpoint)
        try:
            before = bus.call("recorder", "status", Nothing(), Status)
            assert stack.restart_dead() == []
            os.kill(before.pid, signal.SIGKILL)
            assert eventually(stack.restart_dead) == ["recorder"]
            # Where it stood, an answer of the dead one may still be awaited for a moment.
            assert ready(bus, "recorder").pid != before.pid
        finally:
            bus.close()
        assert f"--recordings\0{folder}".encode() in b"".join(
            Path(f"/proc/{pid}/cmdline").read_bytes() for pid in processes_of(robot)
        )
    assert [record.name for record in caplog.records].count("stack") == 1
    assert "it is started again" in caplog.text


@pytest.mark.zenoh
@pytest.mark.parametrize(
    ("number", "when"),
    [
        (signal.SIGTERM, "starting"),
        (signal.SIGKILL, "starting"),
        (signal.SIGINT, "running"),
        (signal.SIGHUP, "running"),
    ],
)
def test_no_signal_leaves_orphans(robot: str, tmp_path: Path, number: signal.Signals, when: str) -> None:
    name = f"orphans-{number}-{when}-{os.getpid()}"
    with subprocess.Popen(
        [sys.executable, "-c", START, name, str(tmp_path)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as parent:
        assert parent.stdout is not None
        assert parent.stderr is not None
        if when == "running":
            assert parent.stdout.readline() == "ready\n"
            assert len(processes_of(name)) == 2
        else:
            eventually(lambda: processes_of(name), timeout_s=60.0)
        parent.send_signal(number)
        status = parent.wait(60.0)
        eventually(lambda: not processes_of(name))
        if number != signal.SIGKILL:
            assert (status, parent.stderr.read()) == (130, "smal: interrupted\n")


def test_a_service_that_keeps_dying_is_started_less_and_less_often() -> None:
    now = [0.0]
    backoff = Backoff(lambda: now[0])
    spacings = []
    for _ in range(8):
        began = now[0]
        assert backoff.mourn()
        assert not backoff.mourn()
        now[0] += backoff.wait_s()
        assert backoff.wait_s() == 0.0
        spacings.append(now[0] - began)
        backoff.begin()
    assert spacings == [FIRST_S, 2.0, 4.0, 8.0, 16.0, LONGEST_S, LONGEST_S, LONGEST_S]
    now[0] += STEADY_S
    backoff.mourn()
    assert backoff.wait_s() == 0.0
    backoff.begin()
    backoff.mourn()
    assert backoff.wait_s() == 2.0

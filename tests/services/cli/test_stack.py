"""The processes of a stack: none stays behind, the dead come back, and why one died is said in one line."""

import logging
import os
import re
import signal
import subprocess
import sys
from contextlib import closing
from dataclasses import replace
from itertools import chain
from pathlib import Path

import pytest

from schemas.rpc import Nothing, Status
from services.cli import stack
from services.cli.doctor import check_port
from services.cli.stack import Stack, StackPlan, flags, instances
from services.kit.bus import Bus
from services.kit.errors import JobError
from tests.services.cli.conftest import Smal
from tests.services.waiting import eventually, ready

START = """
import sys
from pathlib import Path
from services.cli.main import main
from services.cli.stack import stack_for
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
            if alive and f"SMAL_ROBOT={robot}".encode() in (folder / "environ").read_bytes().split(
                b"\0"
            ):
                found.add(int(folder.name))
        except OSError:
            pass
    return found


@pytest.fixture
def robot(request: pytest.FixtureRequest) -> str:
    """Name a robot that no other test has."""
    return f"{request.node.name[:20].lower().replace('[', '-')}{os.getpid()}"


def plan(
    robot: str, endpoint: str, tmp_path: Path, *services: str, **flags_of: tuple[str, ...]
) -> StackPlan:
    return StackPlan(("router", *services), robot, endpoint, flags_of, logs=tmp_path / "logs")


def test_a_service_that_cannot_start_is_named_with_its_last_line(
    robot: str, free_endpoint: str, tmp_path: Path
) -> None:
    missing = tmp_path / "none.smal"
    failing = Stack(plan(robot, free_endpoint, tmp_path, "policy", policy=flags(model=missing)))
    with pytest.raises(JobError) as caught, failing:
        pass
    assert str(caught.value) == f"policy: {missing}: cannot be read: No such file or directory"
    eventually(lambda: not processes_of(robot))


def test_a_service_that_hangs_in_starting_is_named(
    robot: str,
    free_endpoint: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    monkeypatch.setattr(stack, "_TELL_S", 0.1)
    warn = stack._log.warning

    def tell(*said: object) -> None:
        warn(*said)
        if "waiting for ever" in str(said):
            monkeypatch.setattr(stack, "PATIENCE_S", 0.0)

    monkeypatch.setattr(stack._log, "warning", tell)
    hanging = {"recorder": "tests.services.cli.hanging"}
    with (
        pytest.raises(JobError) as caught,
        Stack(replace(plan(robot, free_endpoint, tmp_path, "recorder"), modules=hanging)),
    ):
        pass
    assert re.fullmatch(r"not ready after \d+ s: recorder \(waiting for ever\)", str(caught.value))
    assert re.search(r"waiting for \d+ s for recorder", caplog.text)
    eventually(lambda: not processes_of(robot))


def test_a_dead_service_comes_back_with_its_flags(
    robot: str, free_endpoint: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    folder = tmp_path / "drives"
    settings = plan(robot, free_endpoint, tmp_path, "recorder", recorder=flags(recordings=folder))
    with Stack(settings) as running, caplog.at_level(logging.WARNING):
        running.check()
        # Recorder, router, and what counts declarations for it.
        eventually(lambda: len(processes_of(robot)) == 3)
        bus = Bus(robot, free_endpoint)
        try:
            before = bus.call("recorder", "status", Nothing(), Status)
            assert running.restart_dead() == []
            os.kill(before.pid, signal.SIGKILL)
            assert eventually(running.restart_dead) == ["recorder"]
            # Where it stood, an answer of the dead one may still be awaited for a moment.
            assert ready(bus, "recorder").pid != before.pid
        finally:
            bus.close()
        assert f"--recordings\0{folder}".encode() in b"".join(
            Path(f"/proc/{pid}/cmdline").read_bytes() for pid in processes_of(robot)
        )
    eventually(lambda: not processes_of(robot))
    assert sum("restarting" in record.getMessage() for record in caplog.records) == 1


@pytest.mark.zenoh
@pytest.mark.parametrize(
    ("number", "when"), [(signal.SIGKILL, "starting"), (signal.SIGHUP, "running")]
)
def test_no_signal_leaves_orphans(
    robot: str, tmp_path: Path, number: signal.Signals, when: str
) -> None:
    name = f"orphans-{number}-{when}-{os.getpid()}"
    with subprocess.Popen(
        [sys.executable, "-c", START, name, str(tmp_path)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as parent:
        if when == "running":
            assert parent.stdout.readline() == "ready\n"
            eventually(lambda: len(processes_of(name)) == 3)
        else:
            eventually(lambda: processes_of(name))
        parent.send_signal(number)
        status = parent.wait(100.0)
        eventually(lambda: not processes_of(name))
        if number != signal.SIGKILL:
            assert (status, parent.stderr.read()) == (130, "smal: interrupted\n")


def test_restart_delay_grows_until_service_lives_long() -> None:
    spacings_s = [stack.FIRST_S]
    for _ in range(6):
        spacings_s.append(stack.next_spacing_s(spacings_s[-1], lived_s=0.5))
    assert spacings_s == [1.0, 2.0, 4.0, 8.0, 16.0, 30.0, 30.0]
    assert stack.next_spacing_s(30.0, lived_s=stack.STEADY_S) == stack.FIRST_S


def test_stack_logs_assignment_when_instances_serve_robots(
    robot: str, free_endpoint: str, tmp_path: Path, smal: Smal
) -> None:
    wanted = replace(
        plan(robot, free_endpoint, tmp_path, "features", "recorder"),
        robots=3,
        scale={"features": 2},
    )
    assert wanted.processes() == {
        "router": ("router", robot),
        "features": ("features", robot),
        "features-2": ("features", robot),
        "recorder": ("recorder", robot),
        "recorder-2": ("recorder", f"{robot}-2"),
        "recorder-3": ("recorder", f"{robot}-3"),
    }
    assert (
        "features" not in replace(wanted, scale={"features": 0}).processes()
    )  # On the robot, say.
    with Stack(wanted) as running, closing(Bus(robot, free_endpoint)) as bus:
        (tmp_path / "logs" / "features-2.log").read_text()
        for one in map(bus.of_robot, wanted.fleet):
            ready(one, "recorder")
            one.close()
        # A robot can lack an answer for a moment, while the instances share the fleet.
        served = eventually(
            lambda: (
                (found := instances(bus).get("features", {}))
                and sorted(chain(*found.values())) == sorted(wanted.fleet)
                and found
            )
        )
        _, out, _ = smal("topic", "graph", "--live", "--robot", robot, "--router", free_endpoint)
        assert all(f"<br>{instance}: " in out for instance in served)
        assert re.findall(r"<b>(\w+)</b>", out) == ["features", "recorder"]  # Nobody else is there.
        found = check_port(running.settings)
        assert all(
            f"{instance} serves {' '.join(robots)}" in found for instance, robots in served.items()
        )

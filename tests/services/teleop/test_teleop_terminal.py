"""The real process in a terminal of its own, driving a fake robot through a real router."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import termios
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from services.kit.settings import ServiceSettings
from tests.services.conftest import RunNode
from tests.services.teleop.fake_robot import FakeRobot
from tests.services.waiting import eventually

pytestmark = pytest.mark.zenoh

ROOT = Path(__file__).parents[3]


class Console:
    """``python -m services.teleop`` in a pseudo terminal."""

    def __init__(self, endpoint: str, *flags: str) -> None:
        self._master, self.slave = os.openpty()
        self.mode_before = termios.tcgetattr(self.slave)
        self.output = ""
        self.process = subprocess.Popen(
            [sys.executable, "-m", "services.teleop", "--router", endpoint, "--seed", "5", *flags],
            cwd=ROOT,
            stdin=self.slave,
            stdout=self.slave,
            stderr=self.slave,
            start_new_session=True,
        )
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def type(self, keys: bytes) -> None:
        os.write(self._master, keys)

    def wait_for(self, pattern: str) -> None:
        eventually(lambda: re.search(pattern, self.output))

    def hang_up(self) -> None:
        """Close the window."""
        os.close(self.slave)
        os.close(self._master)

    def close(self) -> None:
        if self.process.poll() is None:
            self.process.kill()
        self.process.wait()
        for end in (self.slave, self._master):
            try:
                os.close(end)
            except OSError:
                continue  # hung up already

    def _read(self) -> None:
        try:
            while data := os.read(self._master, 4096):
                self.output += data.decode(errors="replace")
        except OSError:
            return


@pytest.fixture
def robot(settings: ServiceSettings, run_node: RunNode) -> FakeRobot:
    robot = FakeRobot(settings)
    run_node(robot.node)
    return robot


@pytest.fixture
def console(router_endpoint: str) -> Iterator[Console]:
    console = Console(router_endpoint)
    yield console
    console.close()


def begin(console: Console, robot: FakeRobot) -> None:
    console.wait_for("no episode; press n")
    console.type(b"n")
    console.wait_for(r"frame \d+  \|  robot: stop \(nobody drives\)")


def test_hold_to_drive_release_to_stop(console: Console, robot: FakeRobot) -> None:
    begin(console, robot)
    request = robot.resets[0]
    assert (request.purpose, request.driver, request.mode, request.seed) == ("drive", "teleop", "realtime", 5)
    console.type(b"w")
    eventually(lambda: robot.atoms()[-1:] == ["stop"])
    atoms = robot.atoms()
    assert atoms.count("forward") >= 0.5 * 0.6 / 0.05, "answered every heartbeat for 0.6 s"
    assert atoms == ["forward"] * (len(atoms) - 1) + ["stop"]
    console.type(b"\x1b[D")
    eventually(lambda: robot.atoms()[-1:] == ["left"])
    console.wait_for(r"robot: left \(by teleop\)")
    console.type(b" ")
    eventually(lambda: robot.atoms()[-1:] == ["stop"])


def test_emergency_stop_holds_until_a_new_episode_is_asked_for(console: Console, robot: FakeRobot) -> None:
    begin(console, robot)
    console.type(b"we")
    eventually(lambda: robot.atoms("emergency_stop"))
    console.wait_for(r"EMERGENCY STOP  \|  .*robot: stop \(emergency stop\)")
    driven = len(robot.atoms())
    console.type(b"wwww")
    console.type(b"n")
    eventually(lambda: len(robot.resets) == 2)
    assert len(robot.atoms()) == driven, "no key moves the robot in between"
    assert robot.resets[1].seed == 6
    assert robot.resets[1].release_emergency_stop == len(robot.atoms("emergency_stop"))
    console.wait_for("seed 6")
    eventually(lambda: (console.type(b"w"), robot.atoms()[-1:] == ["forward"])[1])


def test_the_driver_goes_on_when_the_operator_says_so(console: Console, robot: FakeRobot) -> None:
    console.wait_for("no episode; press n")
    console.type(b"r")
    console.wait_for("no episode")
    console.type(b"n")
    console.wait_for(r"robot: stop \(nobody drives\)")
    console.type(b"wr")
    console.wait_for("let go of the key first")
    eventually(lambda: robot.atoms()[-1:] == ["stop"])
    assert not robot.resumed
    console.type(b"r")
    eventually(lambda: robot.resumed == ["drive-1"])


def test_a_stop_that_is_pressed_after_a_new_episode_was_asked_for_is_not_released(
    console: Console, robot: FakeRobot
) -> None:
    console.wait_for("no episode; press n")
    console.type(b"ne")
    console.wait_for("EMERGENCY STOP until")
    console.wait_for(r"an emergency stop came meanwhile; press n again to release it|robot: stop \(emergency stop\)")
    assert all(request.release_emergency_stop == 0 for request in robot.resets)


def test_emergency_stop_without_an_episode_is_sent(console: Console, robot: FakeRobot) -> None:
    console.wait_for("no episode; press n")
    eventually(lambda: (console.type(b"e"), robot.atoms("emergency_stop"))[1])
    console.wait_for("EMERGENCY STOP until you begin a new episode")
    # A release is for one stop: one that was still on its way is released by asking again.
    eventually(lambda: (console.type(b"n"), robot.resets)[1])
    console.wait_for(r"frame \d+  \|  robot: stop \(nobody drives\)")
    eventually(lambda: (console.type(b"w"), robot.atoms()[-1:] == ["forward"])[1])


def test_the_end_of_an_episode_is_told(console: Console, robot: FakeRobot) -> None:
    begin(console, robot)
    robot.finish("collision")
    console.wait_for("ended: collision; press n for the next one")
    console.type(b"q")
    assert console.process.wait(10.0) == 0
    assert robot.ends == [], "it has ended already"


def test_a_refused_reset_is_one_line_and_driving_goes_on(console: Console, robot: FakeRobot) -> None:
    robot.refuse = "no start pose is free"
    console.wait_for("press n")
    console.type(b"n")
    console.wait_for("simulator reset: no start pose is free")
    robot.refuse = None
    console.type(b"n")
    eventually(lambda: robot.resets)


def quit_by_key(console: Console) -> None:
    console.type(b"q")


def quit_by_signal(console: Console) -> None:
    console.process.send_signal(signal.SIGTERM)


def quit_by_hangup(console: Console) -> None:
    console.process.send_signal(signal.SIGHUP)


def quit_by_interrupt(console: Console) -> None:
    console.process.send_signal(signal.SIGINT)


@pytest.mark.parametrize("leave", [quit_by_key, quit_by_signal, quit_by_interrupt, quit_by_hangup])
def test_every_exit_stops_the_robot_ends_the_episode_and_restores_the_terminal(
    console: Console, robot: FakeRobot, leave: Callable[[Console], None]
) -> None:
    begin(console, robot)
    assert not termios.tcgetattr(console.slave)[3] & (termios.ICANON | termios.ECHO)
    console.type(b"w")
    eventually(robot.atoms)
    leave(console)
    assert console.process.wait(10.0) == 0
    eventually(lambda: robot.atoms()[-1:] == ["stop"])
    assert robot.ends == ["drive-1"]
    assert termios.tcgetattr(console.slave) == console.mode_before
    assert "Traceback" not in console.output


def test_a_closed_window_stops_the_robot(console: Console, robot: FakeRobot) -> None:
    begin(console, robot)
    console.type(b"w")
    eventually(robot.atoms)
    console.hang_up()
    assert console.process.wait(10.0) == 0
    eventually(lambda: robot.atoms()[-1:] == ["stop"])
    assert robot.ends == ["drive-1"]


def test_no_router_is_one_line_and_leaves_the_terminal_alone(free_endpoint: str) -> None:
    console = Console(free_endpoint)
    try:
        assert console.process.wait(20.0) == 1
        console.wait_for("no router at")
        assert len(console.output.strip().splitlines()) == 1
        assert termios.tcgetattr(console.slave) == console.mode_before
    finally:
        console.close()


@pytest.mark.parametrize("command", ["services.teleop", "services.cli.main"])
def test_without_a_terminal(command: str) -> None:
    run = "main()" if command == "services.cli.main" else "0"
    arguments = (
        ["-m", "services.teleop"] if run == "0" else ["-c", f"from services.cli.main import main; {run}", "teleop"]
    )
    done = subprocess.run(
        [sys.executable, *arguments],
        cwd=ROOT, stdin=subprocess.DEVNULL, capture_output=True, text=True, check=False, timeout=60,
    )  # fmt: skip
    assert done.returncode == 2
    assert "standard input is not a terminal" in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1

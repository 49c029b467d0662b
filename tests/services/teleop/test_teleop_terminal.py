"""The real process in a terminal of its own, driving a robot on a line through a real router."""

import signal
import termios
import time
from collections.abc import Callable, Iterator
from contextlib import suppress

import pytest

from schemas.command import Command
from schemas.heartbeat import Heartbeat
from schemas.rpc import ArmRequest, EndRequest, ResetReply, ResetRequest
from services.kit.node import Node
from services.kit.settings import ServiceSettings
from services.robot.clock import now_s
from services.robot.gate import CommandGate
from services.robot.runner import EpisodeRunner
from services.robot.service import RobotService
from services.robot.task import OperatorsTask
from tests.command import run_smal
from tests.services.conftest import RunNode
from tests.services.robot.line import LineBody
from tests.services.teleop.console import Console
from tests.services.waiting import eventually

pytestmark = pytest.mark.zenoh

#: As the kitty keyboard protocol has it.
W_PRESSED = b"\x1b[119u"
W_REPEATED = b"\x1b[119;1:2u"
W_RELEASED = b"\x1b[119;1:3u"
A_PRESSED = b"\x1b[97u"
A_RELEASED = b"\x1b[97;1:3u"
#: How a robot that has no time refuses: a person presses again.
REFUSED = r"robot \w+: |press again"
HOLD_S = 2.0  # The longest that can be set.


class Robot(RobotService):
    """A robot on a line that notes what it hears; it misses nobody, so that a busy machine changes nothing."""

    def __init__(self, settings: ServiceSettings) -> None:
        self.gate = CommandGate(first_stop=1)
        self.gate.watch = lambda _now_s: None
        self.commands: list[tuple[float, Command]] = []
        self.beats: list[Heartbeat] = []
        self.arms: list[int] = []
        self.resets: list[ResetRequest] = []
        self.ends: list[EndRequest] = []
        # Callbacks that run when an answer is due, before the answer.
        self.before_arm: Callable[[], object] = bool
        self.before_reset: Callable[[], object] = bool
        runner = EpisodeRunner(LineBody(now_s), OperatorsTask(), self.gate, settings.robot, "s")
        hear = runner.hear
        runner.hear = lambda beat: (self.beats.append(beat), hear(beat))[1]
        super().__init__(runner, Node("robot", settings))

    def atoms(self, source: str = "teleop") -> list[str]:
        """Return what one source asked for, in order."""
        return [command.atom for _, command in self.commands if command.source == source]

    def take(self, command: Command) -> None:
        self.commands.append((time.monotonic(), command))
        super().take(command)

    def arm(self, request: ArmRequest) -> None:
        self.arms.append(request.stop)
        self.before_arm()
        super().arm(request)

    def reset(self, request: ResetRequest) -> ResetReply:
        self.before_reset()
        reply = super().reset(request)
        self.resets.append(request)
        return reply

    @property
    def ended_what_it_began(self) -> bool:
        """Whether the one episode was ended; each press of the key asks with the next seed."""
        begun = [f"drive-{request.seed}-s-1" for request in self.resets]
        return bool(begun) and [request.episode for request in self.ends] == begun

    def end(self, request: EndRequest) -> None:
        self.ends.append(request)
        super().end(request)


@pytest.fixture
def robot(settings: ServiceSettings, run_node: RunNode) -> Robot:
    robot = Robot(settings)
    run_node(robot._node)
    return robot


@pytest.fixture
def console(router_endpoint: str) -> Iterator[Console]:
    console = Console(router_endpoint)
    yield console
    console.close()


@pytest.fixture
def told(router_endpoint: str) -> Iterator[Console]:
    """Open a terminal that tells releases; without them a key would be held for as long as can be set."""
    console = Console(
        router_endpoint, "--first-hold-s", f"{HOLD_S}", "--repeat-hold-s", f"{HOLD_S}"
    )
    console.tell_releases()
    yield console
    console.close()


def begin(console: Console, robot: Robot) -> None:
    console.wait_for(r"robot: not armed  \|")
    console.press_until(b"n", r"frame \d+  \|  robot: stop \(no driver\)", unless=REFUSED)
    assert len(robot.resets) == 1


def hear(robot: Robot, beats: int) -> None:
    """Wait for so many heartbeats more."""
    until = len(robot.beats) + beats
    eventually(lambda: len(robot.beats) >= until)


def test_hold_to_drive_release_to_stop(console: Console, robot: Robot) -> None:
    begin(console, robot)
    request = robot.resets[0]
    assert (request.purpose, request.driver, request.mode) == ("drive", "teleop", "realtime")
    assert request.seed >= 5
    assert request.max_ticks is None, "a person ends it"
    console.type(b"w")
    eventually(lambda: robot.atoms()[-1:] == ["stop"])
    atoms = robot.atoms()
    assert atoms == ["forward"] * (len(atoms) - 1) + ["stop"]
    console.type(b"\x1b[D")
    eventually(lambda: robot.atoms()[-1:] == ["left"])
    console.wait_for(r"robot: left \(by hand\)")
    console.type(b" ")
    eventually(lambda: robot.atoms()[-1:] == ["stop"])


def test_keys_bend_and_stop_at_once_when_releases_are_reported(told: Console, robot: Robot) -> None:
    begin(told, robot)
    for typed, velocity in (
        (W_PRESSED + A_PRESSED, (1.0, 1.0)),
        (A_RELEASED, (1.0, 0.0)),
        (W_RELEASED, (0.0, 0.0)),
    ):
        told.type(typed)
        eventually(
            lambda wanted=velocity: robot.commands and robot.commands[-1][1].velocity == wanted
        )

    def stops_at_once() -> bool:
        driven = len(robot.commands)
        told.type(W_PRESSED + W_REPEATED)
        eventually(lambda: "forward" in [command.atom for _, command in robot.commands[driven:]])
        let_go_s = time.monotonic()
        told.type(W_RELEASED)
        eventually(lambda: robot.atoms()[-1] == "stop")
        return robot.commands[-1][0] - let_go_s < HOLD_S / 4

    eventually(stops_at_once)


def test_emergency_stop_holds_until_a_new_episode_is_asked_for(
    console: Console, robot: Robot
) -> None:
    begin(console, robot)
    console.type(b"we")
    eventually(lambda: robot.atoms("emergency_stop"))
    console.wait_for(r"EMERGENCY STOP  \|  .*robot: stop \(emergency stop\)")
    stop = next(command for _, command in robot.commands if command.source == "emergency_stop")
    console.type(b"wwww")

    def asked() -> bool:
        console.type(b"n")
        with suppress(
            pytest.fail.Exception
        ):  # on a busy machine the operator is missed, and another stop latched
            return bool(eventually(lambda: len(robot.resets) == 2, timeout_s=3.0))
        return False

    eventually(asked)
    # A stop overtakes the keys that were pressed before it.
    assert all(one.tick <= stop.tick for _, one in robot.commands if one.source == "teleop"), (
        "a key moves the robot"
    )
    assert robot.resets[1].seed > robot.resets[0].seed
    assert (robot.arms[0], robot.arms[-1]) == (1, 1 + len(robot.atoms("emergency_stop")))
    console.wait_for(f"seed {robot.resets[1].seed}")
    eventually(lambda: (console.type(b"w"), robot.atoms()[-1:] == ["forward"])[1])


@pytest.mark.parametrize("when", ["before_arm", "before_reset"])
def test_emergency_stop_survives_when_pressed_during_arming(
    console: Console, robot: Robot, when: str
) -> None:
    console.wait_for("robot: not armed")
    setattr(
        robot,
        when,
        lambda: (
            console.type(b"e"),
            eventually(lambda: robot.atoms("emergency_stop")),
            setattr(robot, when, bool),
        ),
    )
    console.type(b"n")
    console.wait_for(
        "robot arm: another stop was latched since|robot reset: an emergency stop is latched"
    )
    console.wait_for(r"EMERGENCY STOP  \|  robot: emergency stop")
    assert (robot.arms, robot.resets) == ([1], [])
    # A stop is said again, with a new number, until the robot has it.
    assert robot.gate.latched_stop >= 2
    # The next press is for the stop that has been told since.
    eventually(lambda: (console.type(b"n"), robot.resets)[1])
    assert robot.arms[-1] >= 2


def test_heartbeats_go_on_while_an_episode_begins(console: Console, robot: Robot) -> None:

    def slow() -> None:
        hear(robot, beats=20)
        console.type(b"q")
        console.wait_for("waiting for the robot's answer")
        hear(robot, beats=20)
        assert all(beat.present for beat in robot.beats)

    robot.before_reset = slow
    console.wait_for("robot: not armed")
    console.press_until(b"n", "waiting for the robot's answer", unless=REFUSED)
    assert console.exit_status() == 0
    eventually(lambda: robot.ended_what_it_began)
    eventually(lambda: not robot.beats[-1].present)


def test_an_emergency_stop_is_heard_while_leaving(console: Console, robot: Robot) -> None:
    def slow() -> None:
        console.type(b"q")
        console.wait_for("waiting for the robot's answer")
        console.type(b"we")
        eventually(lambda: robot.atoms("emergency_stop"))

    robot.before_reset = slow
    console.wait_for("robot: not armed")
    console.press_until(b"n", "waiting for the robot's answer", unless=REFUSED)
    assert console.exit_status() == 0
    assert robot.atoms() == [], "but no other key"


def test_frozen_screen_delays_nothing(console: Console, robot: Robot) -> None:
    begin(console, robot)
    console.draws.clear()
    for _ in range(20):
        console.type(b"r" * 400)  # each says or draws something
        hear(robot, beats=1)
    hear(robot, beats=10)
    console.type(b"e")
    eventually(lambda: robot.atoms("emergency_stop"))
    console.process.send_signal(signal.SIGTERM)
    assert console.exit_status() == 0
    eventually(lambda: not robot.beats[-1].present)
    assert termios.tcgetattr(console.slave) == console.mode_before


@pytest.mark.parametrize("leave", [b"q", b"\x03", signal.SIGTERM])
def test_every_exit_stops_the_robot_and_restores_the_terminal(
    console: Console, robot: Robot, leave: bytes | signal.Signals
) -> None:
    """By q, Ctrl-C or a signal."""
    begin(console, robot)
    assert not termios.tcgetattr(console.slave)[3] & (termios.ICANON | termios.ECHO)
    console.type(b"w")
    eventually(robot.atoms)
    console.type(leave) if isinstance(leave, bytes) else console.process.send_signal(leave)
    assert console.exit_status() == 0
    eventually(lambda: not robot.beats[-1].present)
    assert all(beat.present for beat in robot.beats[:-1])
    assert all(beat.answers is not None for beat in robot.beats)
    assert [beat.sequence for beat in robot.beats] == sorted(
        {beat.sequence for beat in robot.beats}
    )
    assert robot.atoms()[-1] == "stop"
    eventually(lambda: robot.ended_what_it_began)
    assert not robot.ends[0].found
    assert termios.tcgetattr(console.slave) == console.mode_before
    console.wait_for(r"\x1b\[\?1004l\x1b\[<u\r\n\Z")
    assert "Traceback" not in console.output


def test_a_closed_window_stops_the_robot(console: Console, robot: Robot) -> None:
    begin(console, robot)
    console.type(b"w")
    eventually(robot.atoms)
    console.hang_up()
    assert console.exit_status() == 0
    eventually(lambda: not robot.beats[-1].present)
    assert robot.atoms()[-1] == "stop"
    eventually(lambda: robot.ended_what_it_began)


def test_without_a_terminal() -> None:
    done = run_smal("teleop", typed="")
    assert done.returncode == 2
    assert "standard input is not a terminal" in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1

"""Session at the keyboard, which connects a terminal to an operator on the bus."""

import secrets
import time
from typing import Annotated, Final

from pydantic import Field

from schemas.base import ATOMS, KEYS, Atom, Velocity
from schemas.codec import printable
from schemas.command import StopCause
from schemas.episode import GoalName, in_words
from schemas.rpc import Nothing, ResetRequest, Status
from services.kit.errors import JobError
from services.kit.node import Node
from services.kit.settings import ServiceSettings
from services.operator.operator import ANSWER_S, POLL_S, RESET_S, SILENCE_S, Operator, Report
from services.teleop.keys import Key, KeyEvent, KeyParser, News
from services.teleop.terminal import Terminal, open_terminal

CONNECT_S: Final = 3.0
HELP: Final = (
    "arrows or w a s d: drive (hold)   space: stop   e: EMERGENCY STOP   n: new episode   f: found, end it   "
    "r: arm, resume   q: quit"
)
NO_RELEASES: Final = (
    "this terminal does not report the release of a key (kitty, foot, ghostty, WezTerm and others "
    "do): the robot continues for up to {:g} s after a tap; space stops it at once"
)
TELLS_S: Final = 1.0  # Timeout for a terminal's answer that it supports releases.
DISK_S: Final = 5.0  # Period of the query for the recorder's disk, and timeout of its answer.
_DISK_ANSWER_S: Final = 1.0
#: Keyboards begin to repeat 0.25 to 0.6 s after the press, and then repeat every 0.03 to 0.1 s.
FIRST_HOLD_S: Final = 0.6
REPEAT_HOLD_S: Final = 0.15
_CAUSES: Final[dict[StopCause | None, str]] = {
    None: "armed",
    "not_armed": "not armed",
    "emergency_stop": "emergency stop",
    "operator_lost": "operator lost; r resumes",
    "wheels": "odometry contradicts the commands; inspect the wheels, r resumes",
    "fault": "its body has failed",
}


class TeleopSettings(ServiceSettings):
    """Settings of the episodes, and of the keyboard's repeat."""

    seed: Annotated[int | None, Field(ge=0, lt=2**63 - 1_000_000)] = None
    """Seed of the first episode, the next ones count up; random by default."""
    goal: GoalName = "victim"
    """Name of the place that the drives lead to."""
    first_hold_s: Annotated[float, Field(gt=0, le=2)] = FIRST_HOLD_S
    """Time for which the first press of a key counts as held; at least the keyboard's delay before
    it repeats.
    """
    repeat_hold_s: Annotated[float, Field(gt=0, le=2)] = REPEAT_HOLD_S
    """Time for which each repeat counts as held; at least the keyboard's interval between two."""


def run(settings: TeleopSettings) -> None:
    """Drive until the operator quits or the process is stopped."""
    with Node("teleop", settings, CONNECT_S) as node:
        node.stop_on_signals()
        with open_terminal() as terminal:
            terminal.say(HELP)
            session = TeleopSession(node, terminal, settings)
            try:
                node.spin()
            finally:
                session.finish()


class TeleopSession:
    """Connects keys and status line of a terminal to an operator, on the node's thread."""

    def __init__(self, node: Node, terminal: Terminal, settings: TeleopSettings) -> None:
        self._node = node
        self._terminal = terminal
        self._parser = KeyParser()
        self._operator = Operator(node, lambda text: terminal.say(printable(text)))
        self._seed = secrets.randbelow(2**31) if settings.seed is None else settings.seed
        self._goal = settings.goal
        self._first_hold_s = settings.first_hold_s
        self._repeat_hold_s = settings.repeat_hold_s
        self._tells_by_s: float | None = time.monotonic() + TELLS_S
        self._held: set[Atom] = set()  # Keys that are held, until a time.
        self._held_until_s = 0.0
        self._leaving = False
        self._disk: str | None = None
        node.apart(DISK_S, self._tell_of_disk)
        node.every(POLL_S, self.poll)

    def poll(self) -> None:
        """Read the keys, handle releases and answers, and draw the status line."""
        typed = self._terminal.read()
        if typed is None:
            self._node.stop()
        for event in self._parser.feed(typed or b""):
            self._take(event)
        self._operator.poll()
        if self._tells_by_s is not None and time.monotonic() > self._tells_by_s:
            self._tells_by_s = None
            self._terminal.say(NO_RELEASES.format(self._first_hold_s))
        self._terminal.show(
            status_line(self._operator.report, self._operator.commands.held, time.monotonic())
        )

    def finish(self) -> None:
        """Stop the robot, end the own episode for a complete recording, and send a farewell."""
        self._operator.hold(None)
        self._leaving = True
        if self._operator.asking:
            self._terminal.say("waiting for the robot's answer, then ending the episode")
            self._wait(RESET_S)
        self._operator.end_mine()
        self._wait(ANSWER_S)
        self._operator.beat(present=False)

    def _wait(self, timeout_s: float) -> None:
        """Wait for an answer while the operator stays present and can still stop the robot."""
        until_s = time.monotonic() + timeout_s
        while self._operator.asking and time.monotonic() < until_s:
            self._node.drain()
            self.poll()
            time.sleep(POLL_S)

    def _take(self, event: KeyEvent) -> None:
        key, released = event
        if key == "tells_releases":
            self._tells_by_s = None
            self._terminal.tells_releases = True
        elif key == "focus_lost":
            self._hold(set())
        elif key in ATOMS and released:
            self._hold(self._held - {key})
        elif key == "emergency_stop" and not released:
            self._operator.stop_for_emergency()
        elif not (released or self._leaving):
            self._press(key)

    def _press(self, key: Key | News) -> None:
        operator = self._operator
        if key in ATOMS:
            # Without release reports a key counts as held until its next repeat is overdue.
            # Terminals with release reports repeat only the last of several held keys, which add
            # up.
            held = self._held if operator.commands.held is not None else set[Atom]()
            hold_s = self._repeat_hold_s if key in held else self._first_hold_s
            self._held_until_s = time.monotonic() + hold_s
            others = held - {"stop"} if self._terminal.tells_releases and key != "stop" else set()
            self._hold({key} | others)
        elif key == "quit":
            self._node.stop()
        elif key == "new_episode":
            self._begin_episode()
        elif key == "resume":
            operator.resume()
        elif key == "found":
            operator.end(found=True)

    def _hold(self, keys: set[Atom]) -> None:
        self._held = keys
        held = Velocity(*map(sum, zip(*(KEYS[key] for key in keys), strict=True))) if keys else None
        self._operator.hold(held, self._held_until_s)

    def _begin_episode(self) -> None:
        request = ResetRequest(
            seed=self._seed,
            purpose="drive",
            goal=self._goal,
            driver="teleop",
            mode="realtime",
            max_ticks=None,
        )
        if self._operator.begin(request):
            self._seed += 1
            self._terminal.say(f"new episode, seed {request.seed} ...")

    def _tell_of_disk(self) -> None:
        """Print the space on the recorder's disk; on a separate thread, since motion must not wait."""
        try:
            told = self._node.bus.call(
                "recorder", "status", Nothing(), Status, _DISK_ANSWER_S
            ).detail.get("disk")
        except JobError:
            told = None
        if told not in (None, self._disk):
            self._terminal.say(f"RECORDING: {printable(str(told))}")
        self._disk = None if told is None else str(told)


def status_line(robot: Report, held: Velocity | None, now_s: float) -> str:
    """Return the status line of a robot, with the held keys."""
    if robot.waiting:
        episode = "waiting for the robot; a simulator's first picture takes a while"
    elif robot.episode is None:
        episode = (
            f"ended: {in_words(robot.outcome, robot.right)}; n: next episode"
            if robot.outcome
            else "no episode; n: begin one"
        )
    else:
        episode = (
            "a person drives"
            if robot.driver == "teleop"
            else f"driver: {robot.driver or 'unknown'}"
        )
    keys = "-" if held is None else "+".join(held.keys) or "stop"
    parts = ["EMERGENCY STOP"] if robot.emergency else []
    return "  |  ".join([*parts, *_robot(robot, now_s), f"you: {keys}", episode])


def _robot(robot: Report, now_s: float) -> list[str]:
    if robot.episode is None or robot.at is None:
        return [f"robot: {_CAUSES[robot.cause] if robot.answers else '-'}"]
    if now_s - robot.at > SILENCE_S:
        return [f"NO REPORT OF THE ROBOT for {now_s - robot.at:.0f} s"]
    reasons = {
        "command": "by hand" if robot.source == "teleop" else f"by {robot.source}",
        "obstacle": "obstacle or unknown ground ahead; release and hold again to continue slowly",
        "no_depth": "the depth camera shows no ground, is frozen, or is too late",
        "insisted": "slowly, since you insist",
        "radius": "a car turns only while it drives, at its minimum radius",
        "silence": "no driver",
        "taken_over": "you have taken over; r resumes",
        "deaf": "no echo from the router; it stands until the link works",
        "latched_stop": _CAUSES[robot.cause],
    }
    doing = f"{robot.atom or '-'} ({reasons.get(robot.reason or '', '-')})"
    return [f"frame {robot.tick}", f"robot: {doing}", f"refused {robot.refused}"]

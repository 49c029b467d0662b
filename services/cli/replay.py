"""``smal replay``: publish a recording in place of its robot."""

import secrets
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Final

from typer import Argument, Option

from schemas.base import Message
from schemas.episode import Episode
from schemas.topics import JPEG, Topic
from services.cli import options
from services.experiments.progress import bar_of
from services.kit.errors import UsageError
from services.kit.node import Node
from services.recordings.replay import REPLAYABLE, Tick, Track, end_of, tracks_of
from services.robot.service import ROBOT, check_alone

# Timeout for a subscriber of the images; earlier messages are lost without one.
LISTENERS_S: Final = 2.0


def replay(
    *,
    recording: Annotated[Path, Argument(help="Recording (MCAP).")],
    rate: Annotated[
        float, Option(min=0.01, max=100.0, help="Playback speed (1 = real time).")
    ] = 1.0,
    step: Annotated[
        bool, Option("--step", help="Step mode: Enter publishes the next frame.")
    ] = False,
    names: Annotated[
        str, Option("--topics", help="Topics to replay, comma-separated.", metavar="NAMES")
    ] = ",".join(REPLAYABLE),
    reach: options.Reach,
) -> None:
    """Publish a recording with its timing, so that a stack runs without a robot.

    The stack is `smal up --robot-body none`; its features, recognition and policy answer as usual.
    The topics of the robot and its camera are published with the id of a new episode and current
    timestamps. Commands are never replayed. A robot with the same id must not run. With --secure
    the command uses the robot's certificate.

    Example: smal replay drives/drive-1.mcap --rate 2
    """
    chosen = [name.strip() for name in names.split(",")]
    for name in chosen:
        if name not in REPLAYABLE:
            raise UsageError(
                f"--topics: {name!r} is unsupported; choose from {', '.join(REPLAYABLE)}"
            )
    wanted = {name: topic for name, topic in REPLAYABLE.items() if name in chosen}
    tracks = tracks_of(options.existing(recording))
    # Robots run the same check, so no robot with this id starts until the replay ends.
    check_alone(
        reach.settings,
        "end it first; start a stack without a robot with `smal up --robot-body none`",
    )
    with Node(ROBOT, reach.settings) as node:
        node.spin(timeout_s=0.0)  # From here on it reports that it is ready.
        if JPEG.name in wanted:
            _await_listeners(node)
        session = secrets.token_hex(6)
        for number, track in enumerate(tracks, 1):
            player = Player(node, track, f"replay-{session}-{number}", wanted)
            sys.stderr.write(
                f"smal: episode {track.episode} of {track.robot} as {player.episode}\n"
            )
            player.run(_by_hand if step else _by_clock(rate))
            if track.bad:
                sys.stderr.write(f"smal: left out {track.bad} undecodable messages\n")


def _by_clock(rate: float) -> Callable[[Tick], bool]:
    """Create a function that waits until a tick is due and always continues."""
    began_s = time.monotonic()

    def wait(tick: Tick) -> bool:
        time.sleep(max(0.0, began_s + tick.since_s / rate - time.monotonic()))
        return True

    return wait


def _by_hand(tick: Tick) -> bool:
    sys.stderr.write(f"tick {tick.number}; Enter continues, Ctrl-D ends: ")
    sys.stderr.flush()
    return sys.stdin.readline() != ""


class Player:
    """Publishes the selected topics of a recorded episode under the id of a new episode."""

    def __init__(self, node: Node, track: Track, episode: str, wanted: dict[str, Topic]) -> None:
        self.episode = episode
        self._node = node
        self._track = track
        self._wanted = wanted
        self._started: Episode | None = None
        self._last: Message | None = None
        node.detail = lambda: {
            "replayed": track.episode,
            "episode": episode,
            "tick": getattr(self._last, "tick", None),
        }

    def run(self, wait: Callable[[Tick], bool]) -> None:
        """Publish each tick after `wait` returns; stop when `wait` reports the end."""
        ticks = self._track.play(self._node.robot, self.episode, time.time_ns(), self._wanted)
        try:
            for tick in bar_of(ticks, total=len(self._track), unit="frame"):
                if not wait(tick):
                    break
                for message in tick.messages:
                    self._tell(message)
        finally:
            if self._started is not None and self._last is not None:
                self._tell(end_of(self._last, self._started))

    def _tell(self, message: Message) -> None:
        self._node.publish(message)
        self._last = message
        if isinstance(message, Episode):
            self._started = None if message.event == "ended" else message


def _await_listeners(node: Node) -> None:
    deadline_s = time.monotonic() + LISTENERS_S
    while not node.bus.has_listeners(JPEG):
        if time.monotonic() > deadline_s:
            stack = f"smal up --robot-body none --robot {node.robot}"
            sys.stderr.write(
                f"smal: no subscriber for {JPEG.name} of {node.robot}; start its stack ({stack})\n"
            )
            return
        time.sleep(0.02)

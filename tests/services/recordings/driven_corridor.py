"""A drive through the corridor of ``tests.corridor``, recorded: what to replay, and what a library is shown of it."""

import math
from pathlib import Path
from typing import Final

from schemas.base import Message
from schemas.command import Command, CommandApplied
from schemas.episode import Episode
from services.kit.cameras import camera_info
from services.recordings.writer import EpisodeWriter
from smal.camera import Camera
from tests import corridor
from tests.services.recordings.recorded_messages import START_NS, seen

NAME: Final = "drive-corridor"
FRAMES: Final = 30


def pose(tick: int) -> corridor.Pose:
    """Return where the robot was: it weaves, and stands at the end."""
    along = min(tick, 24)
    return 0.16 * along, 0.3 * math.sin(along / 4), 0.25 * math.cos(along / 4)


def header(tick: int) -> Message:
    """Begin a message; a frame now and then comes late, as it does."""
    return Message(
        robot="teacher",
        episode=NAME,
        tick=tick,
        stamp_ns=START_NS + tick * 100_000_000 + tick % 3 * 7_000_000,
    )


def told(tick: int) -> list[Message]:
    """Return what was said of one frame, and who commanded."""
    here = header(tick)
    return [
        *([camera_info(here, Camera(0.7), corridor.WIDTH, corridor.HEIGHT)] if tick == 0 else []),
        *seen(here, corridor.view(*pose(tick)), pose(tick), speed_m_s=1.6),
        Command.after(here, source="teleop", atom="forward", session="somebody"),
        CommandApplied.after(
            here, atom="forward", linear=1.0, angular=0.0, source="teleop", reason="command"
        ),
    ]


def event(tick: int, name: str, **more: object) -> Episode:
    """Return an event of the drive."""
    fields = {"event": name, "purpose": "drive", "driver": "teleop", "seed": 0, "goal": "end"}
    return Episode.after(header(tick), **fields, world="corridor", **more)


def record(folder: Path, frames: int = FRAMES) -> Path:
    """Write the recording."""
    started = event(0, "started")
    writer = EpisodeWriter.begin(folder, started)
    writer.write(started)
    for tick in range(frames):
        for message in told(tick):
            writer.write(message)
    writer.write(event(frames - 1, "ended", outcome="found", judge="operator"))
    return writer.seal()

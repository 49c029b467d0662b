"""Episodes made up for the tests: every message that a robot would send."""

from collections.abc import Iterable, Iterator

import numpy as np
from numpy.typing import NDArray

from schemas.action import Action
from schemas.array import Float32Array
from schemas.base import ATOMS, KEYS, SOURCES, Message
from schemas.camera import CameraInfo, CompressedImage
from schemas.command import Command, CommandApplied
from schemas.episode import Episode, EventName, Outcome, Purpose
from schemas.motion import Imu, ImuSample, Odometry, TrackedPose, TruePose
from schemas.state import State
from schemas.taught_map import TaughtMap
from services.kit.jpeg import encode_jpeg

MODEL = "fedcba9876543210"
WIDTH = 64
HEIGHT = 48
FOCAL_PX = 40.0
START_NS = 1_700_000_000_000_000_000


def header(episode: str, tick: int) -> Message:
    return Message(
        robot="rescuebot", episode=episode, tick=tick, stamp_ns=START_NS + tick * 100_000_000
    )


def event(
    episode: str,
    tick: int,
    name: EventName,
    outcome: Outcome | None = None,
    purpose: Purpose = "drive",
    seed: int = 7,
) -> Episode:
    fields = {"event": name, "purpose": purpose, "seed": seed, "outcome": outcome}
    return Episode.after(header(episode, tick), **fields, driver="expert", world="campus")


def pixels(tick: int) -> NDArray[np.uint8]:
    return np.full((HEIGHT, WIDTH, 3), (250, 10, (3 * tick) % 256), np.uint8)


def image(episode: str, tick: int) -> CompressedImage:
    data = encode_jpeg(pixels(tick))
    return CompressedImage.after(header(episode, tick), width=WIDTH, height=HEIGHT, data=data)


def seen(
    cause: Message, pixels: NDArray[np.uint8], pose: Iterable[float], speed_m_s: float = 2.0
) -> list[Message]:
    """Give the image of a frame, and where odometry has the robot: (x, y, heading)."""
    height, width, _ = pixels.shape
    x_m, y_m, heading_rad = pose
    return [
        CompressedImage.after(cause, width=width, height=height, data=encode_jpeg(pixels)),
        Odometry.after(
            cause,
            x_m=x_m,
            y_m=y_m,
            heading_rad=heading_rad,
            speed_m_s=speed_m_s,
            turn_rate_rad_s=0.0,
        ),
    ]


def state(episode: str, tick: int) -> State:
    return State.after(
        header(episode, tick), status="unknown", model=MODEL, score=0.25, residual=0.75
    )


def imu(episode: str, tick: int) -> Imu:
    samples = tuple(
        ImuSample(
            after_s=round(0.1 * tick - 0.08 + 0.02 * k, 2),
            angular_velocity_rad_s=(0.001, -0.002, 0.1 * k),
            acceleration_m_s2=(0.25, -0.5, 9.81),
        )
        for k in range(5 if tick else 0)
    )
    return Imu.after(header(episode, tick), samples=samples)


def applied(
    episode: str, tick: int, sequence: int | None = None, atom: str | None = None
) -> CommandApplied:
    key = atom or ATOMS[tick % 4]
    return CommandApplied.after(
        header(episode, tick),
        **KEYS[key]._asdict(),
        sequence=tick if sequence is None else sequence,
        atom=key,
        source="expert",
        reason="command",
    )


def command(episode: str, tick: int, source: str = "expert", sequence: int = 0) -> Command:
    return Command.after(
        header(episode, tick), source=source, sequence=sequence, atom=ATOMS[tick % 4]
    )


def frame(episode: str, tick: int) -> list[Message]:
    """Everything that descends from one camera frame, what the actuator then does excepted."""
    cause = header(episode, tick)
    return [
        TruePose.after(cause, x_m=1.5 * tick, y_m=-2.0, heading_rad=0.5),
        TrackedPose.after(
            cause, visible=True, x_m=1.5 * tick, y_m=-2.0, heading_rad=0.5, error_px=0.25
        ),
        Odometry.after(
            cause, x_m=1.5 * tick, y_m=0.1, heading_rad=0.02, speed_m_s=2.0, turn_rate_rad_s=0.1
        ),
        imu(episode, tick),
        CameraInfo.after(
            cause,
            width=WIDTH,
            height=HEIGHT,
            focal_px=FOCAL_PX,
            centre_x_px=WIDTH / 2,
            centre_y_px=HEIGHT / 2,
        ),
        image(episode, tick),
        TaughtMap.after(
            cause,
            model=MODEL,
            keyframes=Float32Array.from_numpy(np.eye(3, dtype=np.float32)),
            begins=(0, 2),
        ),
        state(episode, tick),
        Action.after(cause, kind="look_around", state=None, atoms=("forward", "left")),
        *(command(episode, tick, source) for source in SOURCES),
    ]


def episode(
    name: str, frames: int = 5, purpose: Purpose = "drive", outcome: Outcome = "found"
) -> Iterator[Message]:
    """Give every message of a whole episode, in the order in which the robot would send them."""
    yield event(name, 0, "started", purpose=purpose)
    for tick in range(frames):
        yield from frame(name, tick)
        if tick < frames - 1:
            yield applied(name, tick)
    if outcome == "found":
        yield event(name, frames - 1, "victim_found", purpose=purpose)
    yield event(name, frames - 1, "ended", outcome, purpose=purpose)

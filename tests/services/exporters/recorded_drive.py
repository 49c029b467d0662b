"""One drive along the painted corridor, as our own recorder writes it."""

import math
from collections.abc import Collection
from pathlib import Path
from typing import Any, Final

from schemas.base import ATOMS, KEYS, Atom, Message
from schemas.camera import CameraInfo, CompressedImage
from schemas.command import CommandApplied
from schemas.episode import Episode
from schemas.motion import Imu, ImuSample, Odometry
from services.kit.jpeg import encode_jpeg
from services.recordings.recorded import RecordedEpisode
from services.recordings.writer import EpisodeWriter
from tests import corridor

#: What is done from each tick on; at the last one the robot is there.
MADE: Final[tuple[Atom, ...]] = (
    *["forward"] * 8, *["left"] * 4, *["forward"] * 4, "stop", *["right"] * 5, *["backward"] * 2,
    *["forward"] * 4, "stop",
)  # fmt: skip
SPEED = corridor.STEP_M / 0.1
TURN_RATE = math.radians(4.5) / 0.1
FOCAL_PX: Final = 44.8
START_NS: Final = 1_700_000_000_250_000_000


def poses(share: float = 1.0) -> list[corridor.Pose]:
    """Return where the robot is at each tick, at a share of full speed."""
    found = []
    x = y = heading = 0.0
    for atom in MADE:
        found.append((x, y, heading))
        heading += share * 0.1 * TURN_RATE * ((atom == "left") - (atom == "right"))
        ahead = share * 0.1 * SPEED * ((atom == "forward") - (atom == "backward"))
        x = x + ahead * math.cos(heading)
        y = y + ahead * math.sin(heading)
    return found


def recording(
    folder: Path, episode: str = "drive", *, robot: str = "rescuebot", lost: Collection[int] = (), share: float = 1.0,
    odometry: bool = True, images: bool = True, outcome: str | None = "found", scale: int = 1, start_ns: int = START_NS,
    jpeg: dict[int, bytes] | None = None,
) -> Path:  # fmt: skip
    """Write the recording; ``lost`` are ticks without an image, and ``outcome`` None is a recorder that was killed."""
    folder.mkdir(parents=True, exist_ok=True)

    def header(tick: int) -> Message:
        return Message(
            robot=robot, episode=episode, tick=tick, stamp_ns=start_ns + 100_000_000 * tick
        )

    told: dict[str, Any] = {
        "purpose": "drive", "driver": "teleop", "world": "corridor", "seed": 1, "goal": "dock",
    }  # fmt: skip
    started = Episode.after(header(0), event="started", **told)
    writer = EpisodeWriter.begin(folder, started)
    writer.write(started)
    for tick, (atom, pose) in enumerate(zip(MADE, poses(share), strict=True)):
        for message in _tick(header(tick), atom, pose, share, scale, jpeg or {}):
            unwanted = (isinstance(message, CompressedImage) and (tick in lost or not images)) or (
                isinstance(message, Odometry) and not odometry
            )
            if not unwanted:
                writer.write(message)
    if outcome is None:
        writer.flush()
        writer._sink.close()
        return writer._part
    writer.write(Episode.after(header(len(MADE) - 1), event="ended", outcome=outcome, **told))
    return writer.seal()


def _tick(
    cause: Message,
    atom: Atom,
    pose: corridor.Pose,
    share: float,
    scale: int,
    jpeg: dict[int, bytes],
) -> list[Message]:
    x, y, heading = pose
    image = corridor.view(x, y, heading, scale)
    data = jpeg.get(cause.tick) or encode_jpeg(image)
    height, width = image.shape[:2]
    samples = [
        ImuSample(
            after_s=round(0.1 * cause.tick - before, 2), angular_velocity_rad_s=(0.0, 0.0, before),
            acceleration_m_s2=(0.5, 0.0, 9.81),
        )
        for before in (0.06, 0.02) if cause.tick
    ]  # fmt: skip
    moves = {name: share * value for name, value in KEYS[atom]._asdict().items()}
    made = CommandApplied.after(cause, **moves, atom=atom, source="teleop", reason="command")
    return [
        CompressedImage.after(cause, width=width, height=height, data=data),
        CameraInfo.after(
            cause,
            width=width,
            height=height,
            focal_px=FOCAL_PX * scale,
            centre_x_px=width / 2,
            centre_y_px=height / 2,
            lens="equidistant",
            distortion=(0.01, -0.02, 0.0, 0.0),
        ),
        Odometry.after(
            cause, x_m=x, y_m=y, heading_rad=heading, speed_m_s=1.5, turn_rate_rad_s=0.25
        ),
        Imu.after(cause, samples=tuple(samples)),
        *([made] if cause.tick < len(MADE) - 1 else []),
    ]


def atoms_of(episode: RecordedEpisode) -> dict[int, str]:
    """Return what was made at each tick; at the last one the robot stands."""
    made = {tick: applied.atom for tick, applied in episode.applied.items()}
    return made | {max(episode.images): ATOMS[-1]}

"""A recorded episode, its stretches without a gap, and the names of its demonstrations."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from schemas.base import Atom, Source
from schemas.camera import CameraInfo
from schemas.command import CommandApplied
from schemas.episode import Box, Outcome, Purpose
from schemas.motion import Imu, Odometry, TruePose


@dataclass(eq=False)
class RecordedEpisode:
    """One episode by tick; None stands for unrecorded values."""

    robot: str
    episode: str
    world: str = ""
    seed: int = 0
    purpose: Purpose | None = None
    goal: str = ""
    driver: Source | None = None
    outcome: Outcome | None = None
    end_tick: int | None = None
    box: Box | None = None  # The goal in the last frame.
    #: Ticks before which the robot was kidnapped.
    kidnapped: list[int] = field(default_factory=list)
    #: As recorded, for ``encoding.decode_image``.
    images: dict[int, memoryview] = field(default_factory=dict)
    #: Capture times of the images by the robot's clock, nanoseconds.
    stamps_ns: dict[int, int] = field(default_factory=dict)
    odometry: dict[int, Odometry] = field(default_factory=dict)
    imu: dict[int, Imu] = field(default_factory=dict)
    applied: dict[int, CommandApplied] = field(default_factory=dict)  # From this tick to the next.
    camera: CameraInfo | None = None
    #: True poses, for plots; learning must not use them.
    poses: dict[int, TruePose] = field(default_factory=dict)

    @property
    def frames(self) -> int:
        """Number of recorded images."""
        return len(self.images)

    def seconds(self, tick: int) -> float:
        """Return the robot's time from the first image to that of a tick, seconds."""
        return (self.stamps_ns[tick] - self.stamps_ns[min(self.stamps_ns)]) / 1e9

    def pieces(self) -> list[NDArray[np.int64]]:
        """Return the ticks of each stretch without a gap.

        Every tick of a stretch has an image and a movement, and a pose by odometry if most images
        have one.
        """
        with_pose = len(self.odometry.keys() & self.images) > len(self.images) / 2
        ticks = np.array(
            [
                tick
                for tick in sorted(self.images)
                if (tick in self.applied or self.is_goal(tick))
                and (tick in self.odometry or not with_pose)
            ],
            dtype=np.int64,
        )
        breaks = np.flatnonzero(np.diff(ticks) > 1) + 1
        return [piece for piece in np.split(ticks, breaks) if piece.size]

    def is_goal(self, tick: int) -> bool:
        """Return whether this is the last frame of an episode that ended with ``found``."""
        ended_here = self.outcome == "found" and tick == self.end_tick
        return ended_here and tick == max(self.images)

    def atom(self, tick: int) -> Atom:
        """Return the action from this tick to the next, or a stop at the goal."""
        return "stop" if self.is_goal(tick) else self.applied[tick].atom


def piece_name(episode: str, ticks: NDArray[np.int64]) -> str:
    """Return the name of a piece of an episode."""
    return f"{episode}[{ticks[0]}-{ticks[-1]}]"


def episode_of(name: str) -> str:
    """Return the episode of a demonstration, which can be a piece of the episode."""
    return name.partition("[")[0]


def ticks_of(names: Sequence[str], frames: int) -> list[int]:
    """Return the ticks of a drive of this length by its pieces' names, or () if unnamed."""
    spans = [re.search(r"\[([0-9]{1,18})-([0-9]{1,18})\]$", name) for name in names]
    pieces = [range(int(span[1]), int(span[2]) + 1) for span in spans if span is not None]
    return [tick for piece in pieces for tick in piece] if sum(map(len, pieces)) == frames else []

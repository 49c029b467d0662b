"""A recorded episode, the pieces of it that have no gap, and how demonstrations that are made of them are called."""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

from schemas.base import ATOMS, Source
from schemas.camera import CameraInfo
from schemas.command import CommandApplied
from schemas.episode import Box, Outcome, Purpose
from schemas.motion import Imu, Odometry, Pose
from smal.teaching.demonstration import Made

_STOP: Final = ATOMS.index("stop")


@dataclass(frozen=True, eq=False)
class Piece:
    """Successive frames of one episode without a gap."""

    ticks: NDArray[np.int64]  # (f,), each one more than the last.
    features: Made  # (f, m), raw feature vectors.
    atoms: NDArray[
        np.int8
    ]  # (f,), index in ``schemas.base.ATOMS`` of the movement between frame k and frame k + 1.
    ahead: NDArray[
        np.float32
    ]  # (f,), fraction of the nominal speed at which the robot went ahead in turning then.
    images: (
        tuple[memoryview, ...] | None
    )  # As recorded (``encoding.decode_image``), one a frame; or None.
    odometry: (
        NDArray[np.float64] | None
    )  # (f, 3), metres and radians by the wheels; None if one is missing.
    at_goal: bool  # Whether the last frame is that of an episode which ended with the victim found.


@dataclass(eq=False)
class RecordedEpisode:
    """One episode, everything by tick; None stands for what was not recorded."""

    robot: str
    episode: str
    world: str = ""
    seed: int = 0
    purpose: Purpose | None = None
    goal: str = ""
    driver: Source | None = None
    outcome: Outcome | None = None
    end_tick: int | None = None
    box: Box | None = None  # Where in the last frame the goal is.
    #: Read or make the raw ones, of the wanted fingerprint: a drive's would fill memory.
    features: dict[int, Callable[[], NDArray[np.float32]]] = field(default_factory=dict)
    images: dict[int, memoryview] = field(
        default_factory=dict
    )  # As recorded (for ``encoding.decode_image``).
    odometry: dict[int, Odometry] = field(default_factory=dict)
    imu: dict[int, Imu] = field(default_factory=dict)
    applied: dict[int, CommandApplied] = field(default_factory=dict)  # From this tick to the next.
    camera: CameraInfo | None = None
    poses: dict[int, Pose] = field(
        default_factory=dict
    )  # True poses, for plots; learning must not use them.

    @property
    def frames(self) -> int:
        """How many frames were recorded."""
        return len(self.features.keys() | self.images.keys())

    def pieces(self) -> list[Piece]:
        """Cut the episode wherever features, what was done, or an image or pose that most frames have, are missing."""
        most = len(self.features) / 2
        usual = [
            had for had in (self.images, self.odometry) if len(had.keys() & self.features) > most
        ]
        known = sorted(
            tick
            for tick in self.features
            if (tick in self.applied or self._is_goal(tick)) and all(tick in had for had in usual)
        )
        ticks = np.array(known, dtype=np.int64)
        breaks = np.flatnonzero(np.diff(ticks) > 1) + 1
        return [self._piece(run) for run in np.split(ticks, breaks) if run.size]

    def _piece(self, ticks: NDArray[np.int64]) -> Piece:
        known = ticks.tolist()
        made = [self.applied.get(tick) for tick in known]
        images = tuple(self.images[tick] for tick in known if tick in self.images)
        way = [self.wheels(tick) for tick in known if tick in self.odometry]
        return Piece(
            ticks,
            Made(len(known), lambda frame: self.features[known[frame]]),
            np.array([self._atom(tick) for tick in known], dtype=np.int8),
            np.array([0.0 if one is None else one.linear for one in made], dtype=np.float32),
            images if len(images) == len(known) else None,
            np.array(way) if len(way) == len(known) else None,
            at_goal=self._is_goal(known[-1]),
        )

    def wheels(self, tick: int) -> tuple[float, float, float]:
        """Return x, y in metres and heading in radians by the wheels; KeyError where it was not recorded."""
        pose = self.odometry[tick]
        return pose.x_m, pose.y_m, pose.heading_rad

    def _is_goal(self, tick: int) -> bool:
        """Whether this frame shows the goal: the last one of an episode that ended with ``found`` there."""
        if self.outcome != "found" or tick != self.end_tick:
            return False
        return tick == max(self.features.keys() | self.images.keys())

    def _atom(self, tick: int) -> int:
        # With the victim found the robot stops. Any other end only says that nobody watched any more.
        return _STOP if self._is_goal(tick) else ATOMS.index(self.applied[tick].atom)


def piece_name(episode: str, ticks: NDArray[np.int64]) -> str:
    """Return the name of a piece of an episode."""
    return f"{episode}[{ticks[0]}-{ticks[-1]}]"


def episode_of(name: str) -> str:
    """Return the episode of a demonstration, which may be a piece of it."""
    return name.partition("[")[0]


def ticks_of(names: Sequence[str], frames: int) -> list[int]:
    """Return the ticks of a drive of that many frames by the names of its pieces; empty where they do not say."""
    spans = [re.search(r"\[([0-9]{1,18})-([0-9]{1,18})\]$", name) for name in names]
    pieces = [range(int(span[1]), int(span[2]) + 1) for span in spans if span is not None]
    return [tick for piece in pieces for tick in piece] if sum(map(len, pieces)) == frames else []

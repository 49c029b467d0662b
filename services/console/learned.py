"""The model that the robot goes by, as far as the page draws it: the taught ways, and what they looked like."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from schemas.state import State
from schemas.topics import CAMERA, JPEG, POSE
from services.kit.model_service import identity_of
from services.recordings.encoding import stamped_jpeg
from services.recordings.reader import RecordingError, read_recording
from services.recordings.recorded import RecordedEpisode
from services.recordings.taught import episode_of, ticks_of
from smal.model import Model
from smal.movement import placed
from smal.planning import chosen_goal, cost_to_go


@dataclass(frozen=True, eq=False)
class Learned:
    """What the page knows of a model.

    Attributes
    ----------
    identity
        By which messages tell of it.
    goal
        Where the robot goes.
    drives
        Of each keyframe, its drive.
    along_m
        Of each keyframe, the way from the drive's start.
    cost_s
        Of each keyframe, the time to the goal; infinite where no way leads there.
    poses
        Of each keyframe, x, y and heading: in the world, where its recording tells; else by the wheels.
    images
        Of each keyframe, the taught image as it was recorded; None where its recording is gone.
    world
        Where all of it was taught; empty where the recordings are gone, or several worlds are in them.
    """

    identity: str
    goal: str
    drives: NDArray[np.int32]
    along_m: NDArray[np.float64]
    cost_s: NDArray[np.float64]
    poses: NDArray[np.float64]
    images: tuple[memoryview | None, ...]
    world: str = ""

    def image(self, keyframe: int) -> bytes | None:
        """Return the taught image of a keyframe as JPEG."""
        recorded = self.images[keyframe] if 0 <= keyframe < len(self.images) else None
        return None if recorded is None else stamped_jpeg(bytes(recorded))[1]

    def shown(self) -> dict[str, object]:
        """Return what the page draws once."""
        return {
            "id": self.identity,
            "goal": self.goal,
            "world": self.world,
            "drives": [int(drive) for drive in self.drives],
            "along": _rounded(self.along_m, 2),
            "cost": [round(cost, 1) if math.isfinite(cost) else None for cost in self.cost_s.tolist()],
            "x": _rounded(self.poses[:, 0], 2),
            "y": _rounded(self.poses[:, 1], 2),
        }

    def belief(self, state: State) -> dict[str, object]:
        """Return where a state says that the robot is, most likely."""
        if state.model != self.identity or not state.places:
            return {}
        first = state.places[0]
        x, y, heading = placed(np.array([first.ahead_m, first.left_m, first.turned_rad]), self.poses[first.keyframe])
        cost = float(self.cost_s[first.keyframe])
        return {
            "keyframe": first.keyframe,
            "pose": [round(float(x), 2), round(float(y), 2), round(float(heading), 3)],
            "cost": round(cost, 1) if math.isfinite(cost) else None,
            "sure": round((1.0 - state.lost) * _near(state, self.along_m, self.drives), 3),
        }


def _near(state: State, along_m: NDArray[np.float64], drives: NDArray[np.int32], within_m: float = 2.0) -> float:
    """Return the share of a belief that is within a few metres of its heaviest place, on the same drive."""
    first = state.places[0].keyframe
    return sum(
        place.weight
        for place in state.places
        if drives[place.keyframe] == drives[first] and abs(along_m[place.keyframe] - along_m[first]) <= within_m
    )


def _rounded(values: NDArray[np.float64], digits: int) -> list[float]:
    return [round(value, digits) for value in values.tolist()]


def learned_of(model: Model, goal: str | None, recordings: dict[str, Path]) -> Learned:
    """Return what the page knows of a model.

    Parameters
    ----------
    model
        The model.
    goal
        Where the robot goes; None for the only goal.
    recordings
        Where the recordings are that it may have been learned from, by episode.

    Raises
    ------
    ValueError
        When it has no such goal.
    """
    mapped = model.mapped
    goal = chosen_goal(mapped.goals, goal)
    drives = mapped.drives[mapped.keyframes]
    first = np.searchsorted(mapped.drives, np.arange(len(mapped.goals)))
    poses = mapped.key_poses.copy()
    images: list[memoryview | None] = [None] * len(drives)
    worlds: set[str] = set()
    for drive, (episode, ticks) in enumerate(_taught(model)):
        recorded = _recorded(recordings.get(episode), episode)
        worlds.add("" if recorded is None else recorded.world)
        if recorded is None:
            continue
        for key in np.flatnonzero(drives == drive).tolist():
            frame = int(mapped.keyframes[key] - first[drive])
            tick = ticks[frame] if ticks else max(recorded.images) - (int(mapped.frames[drive]) - 1 - frame)
            images[key] = recorded.images.get(tick)
            pose = recorded.poses.get(tick)
            if pose is not None:
                poses[key] = (pose.x_m, pose.y_m, pose.heading_rad)
    costs, _ = cost_to_go(mapped, goal)
    along_m = mapped.arc[mapped.keyframes] - mapped.arc[first][drives]
    world = worlds.pop() if len(worlds) == 1 else ""
    return Learned(identity_of(model), goal, drives, along_m, costs, poses, tuple(images), world)


def _taught(model: Model) -> Iterator[tuple[str, Sequence[int]]]:
    """Give the episode of each drive of the map, and the ticks of its frames; none where they are its last ones."""
    for names, frames in zip(model.mapped.names, model.mapped.frames.tolist(), strict=True):
        yield episode_of(names[0]), ticks_of(names, frames)


def _recorded(path: Path | None, episode: str) -> RecordedEpisode | None:
    """Read images and true poses of an episode; None where they are gone."""
    if path is None:
        return None
    try:
        episodes = read_recording(path, topics=(JPEG, CAMERA, POSE)).episodes
    except RecordingError:
        return None
    found = next((one for one in episodes if one.episode == episode), None)
    return found if found is not None and found.images else None

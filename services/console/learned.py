"""The loaded model as the page draws it: taught routes and their images."""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from schemas.state import State
from schemas.topics import JPEG, POSE
from services.kit.belief import belief_of
from services.kit.model_service import identity_of
from services.recordings.encoding import stamped_jpeg
from services.recordings.reader import read_recording
from services.recordings.recorded import RecordedEpisode, episode_of, ticks_of
from services.recordings.stream import RecordingError
from smal.model import Model
from smal.movement import placed
from smal.planning import cost_to_go

_NEAR_M = 2.0  # The weights within this distance on the same drive add up to the confidence.


@dataclass(frozen=True, eq=False)
class Learned:
    """Drawable content of a model: its identity, and the properties of its keyframes."""

    identity: str
    goal: str
    drives: NDArray[np.int32]
    along_m: NDArray[np.float64]  # Distance from the start of the drive.
    cost_s: NDArray[np.float64]  # Time to the goal; infinite without a route.
    # x, y and heading: ground truth of the recording, else odometry.
    poses: NDArray[np.float64]
    # Taught images; None if the recording is gone.
    images: tuple[memoryview | None, ...]
    world: str = ""  # World of all recordings; empty if unknown or ambiguous.

    def image(self, keyframe: int) -> bytes | None:
        """Return the taught image of a keyframe as JPEG."""
        recorded = self.images[keyframe] if 0 <= keyframe < len(self.images) else None
        return None if recorded is None else stamped_jpeg(bytes(recorded))[1]

    def shown(self) -> dict[str, object]:
        """Return the content that the page draws once."""
        return {
            "id": self.identity,
            "goal": self.goal,
            "world": self.world,
            "drives": self.drives.tolist(),
            "along": self.along_m.round(2).tolist(),
            "x": self.poses[:, 0].round(2).tolist(),
            "y": self.poses[:, 1].round(2).tolist(),
        }

    def belief(self, state: State) -> dict[str, object]:
        """Return the most likely pose of a state."""
        belief = belief_of(state)
        keyframes = belief.keyframes
        known = len(keyframes) > 0 and keyframes.max() < len(self.poses)
        if state.model != self.identity or not known:
            return {}
        best = int(keyframes[0])
        x, y, heading = placed(belief.offsets[0], self.poses[best])
        beside = np.abs(self.along_m - self.along_m[best]) <= _NEAR_M
        near = beside & (self.drives == self.drives[best])
        cost_s = float(self.cost_s[best])
        return {
            "keyframe": best,
            "pose": [round(float(x), 2), round(float(y), 2), round(float(heading), 3)],
            "cost": round(cost_s, 1) if math.isfinite(cost_s) else None,
            "sure": round((1.0 - belief.lost) * belief.share(near), 3),
        }


def learned_of(model: Model, goal: str | None, recordings: dict[str, Path]) -> Learned:
    """Collect the drawable content of a model.

    Parameters
    ----------
    model : Model
        Loaded model.
    goal : str or None
        Goal of the robot; None for the only goal.
    recordings : dict
        Paths of recordings, by episode.

    Raises
    ------
    ValueError
        The model does not have this goal.
    """
    mapped = model.mapped
    goal = mapped.chosen_goal(goal)
    drives = mapped.key_drives
    first = np.searchsorted(mapped.drives, np.arange(mapped.drive_count))
    poses = mapped.key_poses.copy()
    images: list[memoryview | None] = [None] * len(drives)
    worlds: set[str] = set()
    for drive, (names, frames) in enumerate(zip(mapped.names, mapped.frames.tolist(), strict=True)):
        episode = episode_of(names[0])
        recorded = _recorded(recordings.get(episode), episode)
        worlds.add("" if recorded is None else recorded.world)
        if recorded is None:
            continue
        # Without ticks in the names, the last ticks apply.
        ticks = ticks_of(names, frames) or range(
            max(recorded.images) - frames + 1, max(recorded.images) + 1
        )
        for key in np.flatnonzero(drives == drive).tolist():
            tick = ticks[int(mapped.keyframes[key] - first[drive])]
            images[key] = recorded.images.get(tick)
            if (pose := recorded.poses.get(tick)) is not None:
                poses[key] = pose.pose
    costs, _ = cost_to_go(mapped, goal)
    along_m = mapped.arc[mapped.keyframes] - mapped.arc[first][drives]
    world = worlds.pop() if len(worlds) == 1 else ""
    return Learned(identity_of(model), goal, drives, along_m, costs, poses, tuple(images), world)


def _recorded(path: Path | None, episode: str) -> RecordedEpisode | None:
    """Read images and true poses of an episode; None if they are gone."""
    if path is None:
        return None
    try:
        episodes = read_recording(path, topics=(JPEG, POSE)).episodes
    except RecordingError:
        return None
    found = next((one for one in episodes if one.episode == episode), None)
    return found if found is not None and found.images else None

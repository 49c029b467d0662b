"""Gymnasium environments of the search task, to run other methods in the same worlds.

Importing this module registers ``smal/Campus-v0`` and ``smal/Indoor-v0``:
``gymnasium.make("services.simulator.gymnasium_env:smal/Campus-v0")`` does both.
"""

from typing import Any, Final

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from schemas.base import ATOMS, TICK_S
from schemas.rpc import MAX_TICKS as NO_LIMIT
from schemas.rpc import ResetRequest
from services.simulator.lockstep import LockstepEpisode
from services.simulator.opening import open_simulation
from services.simulator.sensors.camera import CameraSettings
from services.simulator.simulation import Simulation

MAX_TICKS: Final = 3000  # Truncation limit of an episode, frames (five minutes).
COLLISION_REWARD: Final = -1.0
_REWARDS: Final = {"found": 1.0, "collision": COLLISION_REWARD}
Info = dict[str, Any]


class SearchEnv(gymnasium.Env[NDArray[np.uint8], np.int64]):
    """Search for the victim with the camera alone.

    Observations are images (height, width, 3), uint8 RGB. Actions are atoms, each held for one
    frame of 0.1 s. The reward is 1 for the victim, -1 for a collision (both terminate the episode),
    else 0. World and settings are the parameters of `open_simulation`, unless a `simulation` is
    given.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": round(1 / TICK_S)}  # noqa: RUF012

    def __init__(
        self,
        world: str = "campus",
        *,
        width: int = 320,
        height: int = 240,
        render_mode: str | None = None,
        simulation: Simulation | None = None,
        **settings: Any,  # noqa: ANN401 - checked by open_simulation
    ) -> None:
        self.render_mode = render_mode
        self._simulation = simulation or open_simulation(
            world, CameraSettings(width, height), **settings
        )
        self.observation_space = spaces.Box(0, 255, (height, width, 3), np.uint8)
        self.action_space = spaces.Discrete(len(ATOMS))
        self._episode: LockstepEpisode | None = None

    def reset(
        self, *, seed: int | None = None, options: Info | None = None
    ) -> tuple[NDArray[np.uint8], Info]:
        """Begin an episode; the same seed gives the same episode.

        `options` can contain a `purpose` (see `sample_start`). `info` contains `pose` and `route`,
        way points (k, 2) in metres for experts.
        """
        super().reset(seed=seed)
        purpose = (options or {}).get("purpose", "run")
        episode = seed if seed is not None else int(self.np_random.integers(2**31))
        request = ResetRequest(seed=episode, purpose=purpose, max_ticks=NO_LIMIT)
        self._episode = LockstepEpisode(self._simulation, request)
        return self._episode.view.image, _info(self._episode) | {
            "route": np.array(self._episode.beginning.route)
        }

    def step(self, action: np.int64) -> tuple[NDArray[np.uint8], float, bool, bool, Info]:
        """Execute an action for one frame.

        `info` contains `pose` and, after the last step, `outcome`: "found" or "collision".
        `truncated` is always False: `gymnasium.make` adds the limit of `MAX_TICKS` steps.
        """
        if self._episode is None:
            raise gymnasium.error.ResetNeeded("call reset before step")
        episode = self._episode
        view = episode.step(ATOMS[int(action)])
        outcome = episode.outcome
        if outcome is None and episode.reached:
            outcome = "found"  # A demonstration continues after this frame.
        info = _info(episode) | ({"outcome": outcome} if outcome else {})
        return view.image, _REWARDS.get(outcome or "", 0.0), outcome is not None, False, info

    def render(self) -> NDArray[np.uint8] | None:
        """Return the last camera image in render mode "rgb_array"."""
        return (
            self._episode.view.image if self._episode and self.render_mode == "rgb_array" else None
        )


def _info(episode: LockstepEpisode) -> Info:
    pose = episode.view.pose
    return {"pose": np.array([pose.x, pose.y, pose.heading])}


for _world in ("campus", "indoor"):
    _name = f"smal/{_world.capitalize()}-v0"
    gymnasium.register(
        _name, entry_point=SearchEnv, max_episode_steps=MAX_TICKS, kwargs={"world": _world}
    )

"""The Gymnasium environment keeps Gymnasium's promises, and those of the simulator: same seed, same episode."""

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from schemas.base import ATOMS
from services.simulator.gymnasium_env import COLLISION_REWARD, MAX_TICKS, SearchEnv
from services.simulator.simulation import Simulation
from services.simulator.world import load_world
from tests.services.simulator.simulator_driving import StubCamera, camera_in

FORWARD = ATOMS.index("forward")
RIGHT = ATOMS.index("right")


@pytest.mark.rendering
def test_gymnasium_check_passes() -> None:
    simulation = Simulation(load_world("indoor"), camera_in("indoor"))
    env = SearchEnv(width=160, height=120, render_mode="rgb_array", simulation=simulation)
    known = gymnasium.spec("smal/Indoor-v0")
    assert (known.max_episode_steps, known.kwargs) == (MAX_TICKS, {"world": "indoor"})
    check_env(env, skip_render_check=True)
    image, info = env.reset(seed=1)
    assert image.std() > 5, "there is something to see"
    np.testing.assert_array_equal(env.render(), image)
    assert len(info["route"]) >= 2
    env.close()


def test_a_wall_ends_the_episode_with_a_penalty() -> None:
    env = SearchEnv(width=32, height=24, simulation=Simulation(load_world("yard"), StubCamera()))
    env.reset(seed=0)
    steps = [env.step(np.int64(RIGHT)) for _ in range(20)]
    assert all((reward, terminated) == (0.0, False) for _, reward, terminated, _, _ in steps)
    for _ in range(60):
        _, reward, terminated, truncated, info = env.step(np.int64(FORWARD))
        if terminated:
            break
    end = (reward, terminated, truncated, info["outcome"])
    assert end == (COLLISION_REWARD, True, False, "collision")

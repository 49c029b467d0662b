"""The scene as a Gymnasium environment with an image observation."""

import math
import os
from typing import Any, Final

import gymnasium
import numpy as np
from numpy.typing import NDArray

os.environ.setdefault("MUJOCO_GL", "egl")  # Without a display; MuJoCo reads it when imported.
import mujoco
from gymnasium import spaces

from tests.benchmarks.rooms.scene import (
    RADIUS_M,
    TRACK_M,
    WAYS,
    clearance_m,
    scene_of,
)

FRAME_S: Final = 0.1
SPEED_M_S: Final = 0.6
TURN_RATE_RAD_S: Final = 0.8
BRAKING_S: Final = 0.1  # From full speed, and from the full turn rate, to standstill.
_STEP_S: Final = 0.02  # Time step of the kinematics: 12 mm at full speed.
FOUND_M: Final = 1.2  # Distance at which the target counts as found, as in SMAL's room.
_VIEW_RAD: Final = math.radians(37.5)  # Half of the field of view.
#: Scatter of a start, and of a start anywhere beside the way, as in SMAL's room.
_SCATTER_M: Final = 0.15
_SCATTER_RAD: Final = math.radians(15.0)
_ASIDE_M: Final = 0.3
_TURNED_RAD: Final = math.radians(40.0)
_ENCODER_SIGMA: Final = 0.01  # Relative error of each wheel's encoder, drawn for each episode.
_PURPOSES: Final = ("drive", "run", "recovery")
Info = dict[str, Any]
Observed = NDArray[np.uint8]
Pose = tuple[float, float, float]


class RoomsEnv(gymnasium.Env[Observed, NDArray[np.float32]]):
    """A differential robot with a camera in four rooms around a courtyard.

    Observations are images (240, 320, 3), uint8 RGB. An action is the linear and the angular
    velocity, -1 to 1 of the robot's own, for 0.1 s. A collision ends an episode with the reward -1.
    `info` has the pose, the odometry of the wheels and ``is_success``, and after a reset the route.
    Options of a reset are ``purpose``, ``start`` ("start" or "anywhere") and ``kidnap_tick``.

    Parameters
    ----------
    way : str
        A name of `WAYS`.
    """

    def __init__(self, way: str, width: int = 320, height: int = 240) -> None:
        self.observation_space = spaces.Box(0, 255, (height, width, 3), np.uint8)
        self.action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)
        self._route = np.array(WAYS[way].points)
        text, files = scene_of(way, (width, height))
        self._model = mujoco.MjModel.from_xml_string(text, files)
        self._data = mujoco.MjData(self._model)
        self._renderer = mujoco.Renderer(self._model, height, width)

    def reset(
        self, *, seed: int | None = None, options: Info | None = None
    ) -> tuple[Observed, Info]:
        """Begin an episode; the same seed and options give the same episode."""
        super().reset(seed=seed)
        asked = options or {}
        purpose = asked.get("purpose", "run")
        # Drives and runs with the same seed are independent.
        self._chance = np.random.default_rng([seed or 0, _PURPOSES.index(purpose)])
        self._kidnap_tick = asked.get("kidnap_tick")
        self._tick = 0
        self._odometry: Pose = (0.0, 0.0, 0.0)
        self._encoders = 1.0 + _ENCODER_SIGMA * self._chance.standard_normal(2)
        self._put(*(self._beside() if asked.get("start") == "anywhere" else self._at_start()))
        return self._seen(), self._info() | {
            "route": self._way_from(self._pose), "found_m": FOUND_M,
        }  # fmt: skip

    def step(self, action: NDArray[np.float32]) -> tuple[Observed, float, bool, bool, Info]:
        """Drive for a frame."""
        linear, angular = np.clip(np.asarray(action, dtype=float), -1.0, 1.0)
        wanted = np.array([linear * SPEED_M_S, angular * TURN_RATE_RAD_S])
        most = np.array([SPEED_M_S, TURN_RATE_RAD_S]) * _STEP_S / BRAKING_S
        collided = False
        for _ in range(round(FRAME_S / _STEP_S)):
            self._velocity += np.clip(wanted - self._velocity, -most, most)
            ahead, turn = self._velocity * _STEP_S
            half = turn * TRACK_M / 2
            rolled_m = np.array([ahead - half, ahead + half])
            self._move(_rolled(self._pose, rolled_m))
            self._odometry = _rolled(self._odometry, rolled_m * self._encoders)
            collided |= self._data.ncon > 0
        self._tick += 1
        if self._tick == self._kidnap_tick:
            self._put(*self._beside())
        return self._seen(), -float(collided), collided, False, self._info()

    def close(self) -> None:
        """Free the renderer."""
        self._renderer.close()

    def _at_start(self) -> Pose:
        (x, y), (to_x, to_y) = self._route[:2]
        aside = self._chance.uniform(-_SCATTER_M, _SCATTER_M, 2)
        heading = math.atan2(to_y - y, to_x - x) + self._chance.uniform(-_SCATTER_RAD, _SCATTER_RAD)
        return float(x + aside[0]), float(y + aside[1]), heading

    def _beside(self) -> Pose:
        """Draw a free pose beside the way, farther from the target than the found distance."""
        legs = np.diff(self._route, axis=0)
        ends = np.cumsum(np.hypot(*legs.T))
        while True:
            along = self._chance.uniform(0.0, ends[-1])
            leg = int(np.searchsorted(ends, along))
            ahead = legs[leg] / np.hypot(*legs[leg])
            aside = self._chance.uniform(-_ASIDE_M, _ASIDE_M)
            x, y = (
                self._route[leg + 1] - ahead * (ends[leg] - along) + aside * ahead[::-1] * (-1, 1)
            )
            heading = math.atan2(ahead[1], ahead[0]) + self._chance.uniform(
                -_TURNED_RAD, _TURNED_RAD
            )
            far = math.dist((x, y), self._route[-1]) > 2 * FOUND_M
            if far and clearance_m(x, y) > RADIUS_M + 0.05:
                return float(x), float(y), heading

    def _way_from(self, pose: Pose) -> list[tuple[float, float]]:
        """Return the way points from a pose on: those of the leg ahead of the nearest point."""
        here = np.array(pose[:2])
        legs = np.diff(self._route, axis=0)
        share = np.clip(
            ((here - self._route[:-1]) * legs).sum(axis=1) / (legs**2).sum(axis=1), 0, 1
        )
        away = np.hypot(*(self._route[:-1] + share[:, None] * legs - here).T)
        ahead = self._route[int(away.argmin()) + 1 :]
        return [(float(x), float(y)) for x, y in (here, *ahead)]

    def _put(self, x: float, y: float, heading: float) -> None:
        """Place the robot at rest; its wheels do not notice."""
        self._velocity = np.zeros(2)  # m/s and rad/s.
        self._move((x, y, heading))

    def _move(self, pose: Pose) -> None:
        """Set the pose and find contacts."""
        self._pose = pose
        self._data.qpos[:] = pose
        mujoco.mj_fwdPosition(self._model, self._data)

    def _seen(self) -> Observed:
        self._renderer.update_scene(self._data, "camera")
        return np.array(self._renderer.render(), dtype=np.uint8)

    def _info(self) -> Info:
        x, y, heading = self._pose
        to_x, to_y = self._route[-1] - (x, y)
        off = math.remainder(math.atan2(to_y, to_x) - heading, math.tau)
        success = math.hypot(to_x, to_y) <= FOUND_M and abs(off) <= _VIEW_RAD
        return {"pose": (x, y, heading), "odometry": self._odometry, "is_success": success}


def _rolled(pose: Pose, rolled_m: NDArray[np.float64]) -> Pose:
    """Return the pose after the left and the right wheel have rolled."""
    x, y, heading = pose
    left, right = rolled_m.tolist()
    ahead = (left + right) / 2
    turn = (right - left) / TRACK_M
    middle = heading + turn / 2
    return x + ahead * math.cos(middle), y + ahead * math.sin(middle), heading + turn

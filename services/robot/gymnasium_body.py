"""Any Gymnasium environment with an image observation as a body of the stack."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import gymnasium
import numpy as np

from schemas.base import KEYS, STANDING, TICK_S, Atom, Velocity
from schemas.rpc import ResetRequest
from services.kit.node import ServiceError
from services.robot.body import Beginning, Kinematics
from services.robot.lockstep import SteppedBody, StepView


class GymnasiumBody(SteppedBody):
    """An environment whose observation is an image, or has one under a key.

    `info["pose"]` (x, y in metres, heading in radians) is the ground truth, if it exists. An end
    with a positive reward is the goal, another end a collision.

    Parameters
    ----------
    env : gymnasium.Env or str
        Environment, or its registered id.
    actions : mapping or callable
        Action of each atom (stop, forward, ...), or of any `Velocity`.
    kinematics : Kinematics
        Speeds of the atoms.
    frame_s : float
        Time that one step takes, seconds.
    image : str, optional
        Key of the image in a dict observation.
    """

    def __init__(
        self, env: gymnasium.Env[Any, Any] | str,
        actions: Mapping[Atom, object] | Callable[[Velocity], object],
        kinematics: Kinematics, *, frame_s: float = TICK_S, image: str | None = None,
    ) -> None:  # fmt: skip
        self._env = gymnasium.make(env) if isinstance(env, str) else env
        spec = self._env.spec
        self.name = type(self._env.unwrapped).__name__ if spec is None else spec.id
        self.kinematics = kinematics
        self.frame_s = frame_s
        self._act = actions if callable(actions) else lambda v: actions[self._nearest(v)]
        self._key = image

    def start(self, request: ResetRequest) -> Beginning:
        """Reset the environment with the seed of the request."""
        observation, info = self._env.reset(seed=request.seed % 2**31)
        self._owed = np.zeros(2)
        self._now = self._seen(observation, info)
        return Beginning()

    def advance(self, velocity: Velocity, duration_s: float) -> None:
        """Take one step; an environment that has ended stays as it is."""
        if not (self._now.reached or self._now.contact):
            observation, reward, ended, _, info = self._env.step(self._act(velocity))
            reached = bool(ended) and float(reward) > 0
            contact = bool(ended) and not reached
            self._now = replace(self._seen(observation, info), reached=reached, contact=contact)

    def _nearest(self, velocity: Velocity) -> Atom:
        """Return the nearest atom; the difference is added to the next velocity."""
        self._owed = np.clip(self._owed, -1, 1) * (velocity != STANDING) + velocity
        atom = min(KEYS, key=lambda one: float(np.linalg.norm(self._owed - KEYS[one])))
        self._owed = self._owed - KEYS[atom]
        return atom

    def _seen(self, observation: object, info: dict[str, Any]) -> StepView:
        image = np.asarray(observation if self._key is None else observation[self._key])  # type: ignore[index]
        if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3:
            raise ServiceError(f"{self.name}: {image.dtype} {image.shape} is not an RGB image")
        return StepView(image, pose=info.get("pose"))

    def observe(self) -> StepView:
        """Return the view after the last step."""
        return self._now

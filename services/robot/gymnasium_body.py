"""Any Gymnasium environment with an image observation as a body of the stack."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import gymnasium
import numpy as np

from schemas.base import KEYS, STANDING, TICK_S, Atom, Velocity
from schemas.rpc import ResetRequest
from services.robot.body import Beginning, Kinematics, OdometryReading
from services.robot.lockstep import SteppedBody, StepView
from smal.movement import Movement


class GymnasiumBody(SteppedBody):
    """An environment whose observation is an image, or has one under a key.

    An end with a positive reward is the goal, another end a collision; truncation is ignored.
    The names of `info` below are optional. With ``route`` and ``found_m`` the scripted expert can drive.

    ============== ========================================================================
    ``pose``       ground truth: x, y in metres, heading in radians
    ``odometry``   pose by the wheels since the reset, in the same units
    ``is_success`` whether the goal is reached; the episode can continue
    ``route``      after a reset: way points (x, y) from the start to the goal, metres
    ``found_m``    after a reset: distance from the end of the route that counts as reached
    ============== ========================================================================

    A subclass whose `conditions` are not empty receives the requested ones as options of `reset`,
    with the ``purpose`` of the episode (drive, run or recovery).

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
        """Reset the environment with the seed of the request, and its conditions as options."""
        names = ("purpose", *self.conditions) if self.conditions else ()
        options = {name: getattr(request, name) for name in names}
        observation, info = self._env.reset(seed=request.seed % 2**31, options=options or None)
        self._owed = np.zeros(2)
        self._ended = False
        self._wheels: tuple[float, float, float] | None = None
        self._now = self._seen(observation, info)
        route = tuple((float(x), float(y)) for x, y in info.get("route", ()))
        return Beginning(route, info.get("found_m"))

    def advance(self, velocity: Velocity, duration_s: float) -> None:
        """Take one step; an environment that has ended stays as it is."""
        if not self._ended:
            observation, reward, ended, _, info = self._env.step(self._act(velocity))
            self._ended = bool(ended)
            seen = self._seen(observation, info)
            reached = seen.reached or (self._ended and float(reward) > 0)
            contact = self._ended and (float(reward) < 0 or not reached)
            self._now = replace(seen, reached=reached, contact=contact)

    def _nearest(self, velocity: Velocity) -> Atom:
        """Return the nearest atom; the difference is added to the next velocity."""
        self._owed = np.clip(self._owed, -1, 1) * (velocity != STANDING) + velocity
        atom = min(KEYS, key=lambda one: float(np.linalg.norm(self._owed - KEYS[one])))
        self._owed = self._owed - KEYS[atom]
        return atom

    def _seen(self, observation: object, info: dict[str, Any]) -> StepView:
        image = np.asarray(observation if self._key is None else observation[self._key])  # type: ignore[index]
        return StepView(
            image,
            reached=bool(info.get("is_success", False)),
            odometry=self._read(info.get("odometry")),
            pose=info.get("pose"),
        )

    def _read(self, wheels: Sequence[float] | None) -> OdometryReading | None:
        """Return a pose by the wheels, with the mean speeds since the frame before."""
        if wheels is None:
            return None
        x, y, heading = map(float, wheels)
        before = self._wheels or (x, y, heading)
        self._wheels = x, y, heading
        moved = Movement.between(before, self._wheels)
        return OdometryReading(
            x, y, heading, moved.ahead / self.frame_s, moved.turn_rad / self.frame_s
        )

    def observe(self) -> StepView:
        """Return the view after the last step."""
        return self._now

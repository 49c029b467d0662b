"""Which velocity: that after which, expected over the belief, least is left to go (QMDP).

Every velocity is rolled out, after what the last one does until this one begins: an arc. What is left from its end to
what each likely place aims at is the way there, and the turn towards it (Littman, Cassandra and Kaelbling 1995).
"""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from smal.movement import Atom, placed, seen_from
from smal.settings import SETTINGS

Floats = NDArray[np.float64]
Share = tuple[float, float]  # Linear, ahead, and angular, to the left: of the robot's speed and turn rate, -1 to 1.
_KEYS: Final[dict[Atom, Share]] = {
    Atom.FORWARD: (1.0, 0.0), Atom.BACKWARD: (-1.0, 0.0), Atom.LEFT: (0.0, 1.0), Atom.RIGHT: (0.0, -1.0),
}  # fmt: skip


class Chassis(NamedTuple):
    """How a robot moves: ways in the map's unit a second, and radians a second; a car does not turn on the spot."""

    speed: float
    turn_rad_s: float
    car: bool

    def arc(self, linear: Floats | float, angular: Floats | float, time_s: float) -> Floats:
        """Return where velocities (v,) lead in a time: ahead, left, turned (v, 3)."""
        turned = np.asarray(angular) * self.turn_rad_s * time_s
        chord = linear * self.speed * time_s * np.sinc(turned / 2.0 / np.pi)
        return np.stack([chord * np.cos(turned / 2.0), chord * np.sin(turned / 2.0), turned], axis=-1)

    def of_atom(self, atom: Atom) -> Share:
        """Return what an atom is; a car looks around by driving slowly."""
        linear, angular = _KEYS.get(atom, (0.0, 0.0))
        return (SETTINGS.look_speed, SETTINGS.look_speed * angular) if self.car and angular else (linear, angular)

    def choose(self, atom: Atom, direction_rad: Floats | None, weights: Floats, last: Share, delay_s: float) -> Share:
        """Return the best velocity for places that aim in such directions (p,), by their weights (p,).

        Without any, and where nobody drove ahead, it is what the atom is. They aim ahead of where the robot is when
        this begins, also beyond the end of the way: nearer, full speed would lead too far.
        """
        if direction_rad is None or self.speed <= 0.0:
            return self.of_atom(atom)
        away = self.speed * (SETTINGS.lookahead_s + delay_s * abs(last[0]))
        aims = np.stack([away * np.cos(direction_rad), away * np.sin(direction_rad)], axis=1)
        shares = np.meshgrid(np.linspace(0.0, 1.0, 5), np.linspace(-1.0, 1.0, 41))
        linear, angular = (share.ravel() for share in shares)
        # Who stands sees nothing new.
        can = (linear > 0.0) & (np.abs(angular) <= linear) if self.car else linear + np.abs(angular) >= 0.25
        linear, angular = linear[can], angular[can]
        ends = placed(self.arc(linear, angular, SETTINGS.lookahead_s), self.arc(*last, delay_s))
        x, y, _ = np.moveaxis(seen_from(np.pad(aims, ((0, 0), (0, 1))), ends[:, None]), -1, 0)
        left_s = np.hypot(x, y) / self.speed
        # Who is nearly there need not turn to it any more.
        turn_s = np.abs(np.arctan2(y, x)) / self.turn_rad_s * np.minimum(left_s / (SETTINGS.lookahead_s / 2.0), 1.0)
        cost_s = (left_s + turn_s) @ weights / weights.sum() + SETTINGS.restless_s * np.abs(angular - last[1])
        best = int(cost_s.argmin())
        return float(linear[best]), float(angular[best])

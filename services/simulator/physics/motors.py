"""The motors' controller: it leads the wheels to the commanded speeds no faster than the tyres can follow."""

from __future__ import annotations

from typing import Final

from services.simulator.drive import WheelSpeeds

STANDING: Final = WheelSpeeds(0.0, 0.0)

#: How fast the robot's speed may grow, ahead, and shrink. Pulling ahead leans the weight on the rear caster, which
#: carries some of it even at rest, so the wheels spin earlier than in braking.
ACCELERATION_M_S2: Final = 4.0
BRAKING_M_S2: Final = 6.0
#: The same when the robot is to stand: nearly all that the tyres give, since a stop may be an emergency.
STOPPING_M_S2: Final = 9.0
#: How fast its turning speed may change, at the same time.
TURN_ACCELERATION_RAD_S2: Final = 8.0


def lead(now: WheelSpeeds, wanted: WheelSpeeds, track_m: float, duration_s: float) -> WheelSpeeds:
    """Return the speeds that the wheels are to have a moment later, on the way to the wanted ones.

    The robot's speed and its turning are led separately. If each wheel went its own way as fast as it can, both would
    pull with all they have while the robot speeds up, and nothing would be left to end a turn.

    Parameters
    ----------
    now, wanted
        Speeds of the rims, m/s.
    track_m
        Distance between the wheels.
    duration_s
        Length of the moment, above 0.
    """
    mean, half = (now.left + now.right) / 2, (now.right - now.left) / 2
    ahead, astern = ACCELERATION_M_S2, BRAKING_M_S2
    if wanted == STANDING:
        ahead = astern = STOPPING_M_S2
    change = (wanted.left + wanted.right) / 2 - mean
    mean += max(-astern * duration_s, min(ahead * duration_s, change))
    most = TURN_ACCELERATION_RAD_S2 * track_m / 2 * duration_s
    half += max(-most, min(most, (wanted.right - wanted.left) / 2 - half))
    return WheelSpeeds(mean - half, mean + half)

"""What a robot senses besides its camera's picture: odometry, inertia, and how its camera shakes."""

from services.simulator.sensors.imu import ImuSettings
from services.simulator.sensors.odometry import EncoderSettings
from services.simulator.sensors.shake import LEVEL, ShakeSettings, Tilt
from services.simulator.sensors.suite import Sensors

__all__ = [
    "LEVEL",
    "EncoderSettings",
    "ImuSettings",
    "Sensors",
    "ShakeSettings",
    "Tilt",
]

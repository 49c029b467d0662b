"""What a robot senses besides its camera's picture: odometry, inertia, and how its camera shakes."""

from services.simulator.sensors.imu import ImuReading, ImuSettings
from services.simulator.sensors.odometry import EncoderSettings, OdometryReading
from services.simulator.sensors.shake import LEVEL, ShakeSettings, Tilt
from services.simulator.sensors.suite import Sensors

__all__ = [
    "LEVEL",
    "EncoderSettings",
    "ImuReading",
    "ImuSettings",
    "OdometryReading",
    "Sensors",
    "ShakeSettings",
    "Tilt",
]

"""A base without ROS as a body: lines out, pictures and odometry in."""

import logging
from collections.abc import Callable
from typing import Final

from schemas.base import STANDING, TICK_S, Velocity
from schemas.rpc import ResetRequest
from services.kit.jpeg import encode_jpeg
from services.kit.node import Detail, ServiceError
from services.robot.body import Beginning
from services.robot.clock import SILENCE_S, now_s
from services.robot.gate import MAX_AGE_S
from services.robot.real import BY_HAND, RealView
from services.serial.camera import VideoSource
from services.serial.config import SerialConfig
from services.serial.link import LineLink
from services.serial.odometry import LineOdometry
from smal.camera import Camera

#: Time until a base that starts shows in its pictures, seconds: its delay, and that of the camera.
STARTS_S: Final = 0.3
_log = logging.getLogger("serial")


class SerialBody:
    """A real base as `services.robot.body.Body`.

    It moves while the link works and the required odometry arrives. If the pictures stay equal
    while it drives, the camera is frozen: the robot then stands until it is armed.
    """

    frame_s = TICK_S
    conditions = BY_HAND
    mount = None  # No depth camera.

    def __init__(
        self,
        config: SerialConfig,
        camera: VideoSource,
        odometer: LineOdometry,
        link: LineLink,
        clock: Callable[[], float] = now_s,
    ) -> None:
        self.name = config.name
        self.kinematics = config.kinematics
        self.watchdog_s = config.watchdog_s
        self.braking_s = config.braking_s
        self._config = config
        self._camera = camera
        self._odometer = odometer
        self._link = link
        self._clock = clock
        self._drives_since_s: float | None = None
        self._drove_s = 0.0  # Time of the last `drive`.
        self._changed_s: float | None = None  # Exposure of the last picture that differed.
        self._due_s = 0.0  # Time at which the next different picture is due.
        self._lacked = False

    @property
    def camera(self) -> Camera | None:
        """Camera model of the configured field of view."""
        field_deg = self._config.camera.field_deg
        return None if field_deg is None else Camera.of_field(field_deg)

    def drive(self, velocity: Velocity) -> Velocity:
        """Drive at a velocity; stand while an input is missing, ServiceError if it is frozen."""
        if self._lacks() is not None:
            self.stand()
            return STANDING
        now = self._clock()
        if self._frozen(now):
            self.stand()
            self._changed_s = None  # Once armed, the robot starts as at first.
            raise ServiceError(
                f"{self.name}: camera {self._config.camera.source} shows the same picture while "
                "the robot drives; it stands until it is armed"
            )
        self._link.send(self._config.command(velocity))
        return velocity

    def stand(self) -> None:
        """Stop until the next `drive`."""
        self._drives_since_s = None
        self._link.send(self._config.command(STANDING))

    def _frozen(self, now: float) -> bool:
        """Return whether pictures have stayed equal while the robot drives.

        A robot that stands can see equal pictures, since video codecs remove noise. Time in which
        the robot stands between two equal pictures does not count.
        """
        if self._drives_since_s is None:
            self._drives_since_s = now
            self._due_s += now - self._drove_s
        self._drove_s = now
        if self._changed_s != self._camera.changed_s:
            self._changed_s = self._camera.changed_s
            self._due_s = max(self._changed_s, self._drives_since_s + STARTS_S) + SILENCE_S
        return self._camera.repeats >= 2 and now > self._due_s

    def _lacks(self) -> str | None:
        return self._link.lacks() or self._odometer.lacks() or self._camera.lacks()

    def begin(self, request: ResetRequest) -> Beginning:
        """Prepare an episode; ServiceError if an input is missing or the request is unsupported."""
        picture = self._camera.picture
        lacks = self._lacks()
        if lacks is not None or picture is None:
            raise ServiceError(
                f"{self.name}: {lacks}; smal doctor --robot-config FILE checks each input"
            )
        self._odometer.track.begin(picture.captured_s)
        return Beginning()

    def look(self, tick: int) -> RealView:
        """Return the newest picture and its odometry; without a required input it is not new."""
        del tick
        picture = self._camera.picture
        assert picture is not None  # noqa: S101 - begin has seen a picture
        captured_s = picture.captured_s
        lacks = self._lacks()
        if (lacks is not None) != self._lacked:
            self._lacked = lacks is not None
            _log.warning("%s: %s", self.name, lacks or "all inputs are back")
        if lacks is not None:
            captured_s = min(captured_s, self._clock() - MAX_AGE_S)
        odometry = self._odometer.track.reading(captured_s)
        return RealView(encode_jpeg(picture.image), captured_s, False, odometry, None)

    def peek(self) -> bytes | None:
        """Return the newest picture, as JPEG; None while the camera is silent."""
        picture = self._camera.picture
        if picture is None or self._camera.lacks() is not None:
            return None
        return encode_jpeg(picture.image)

    def detail(self) -> Detail:
        """Return the state of the inputs."""
        picture = self._camera.picture
        return {
            "lacks": self._lacks(),
            "camera_age_s": None
            if picture is None
            else round(self._clock() - picture.captured_s, 3),
            "camera_pace_s": round(self._camera.arrivals.pace_s, 3),
            "odometry_leaps": self._odometer.track.leaps,
        }

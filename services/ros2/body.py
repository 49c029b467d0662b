"""A ROS 2 base as a body: velocities out, frames in. Independent of Zenoh."""

import logging
import math
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Final, Protocol

from schemas.base import STANDING, TICK_S, Velocity
from schemas.rpc import ResetRequest
from services.kit.node import Detail, ServiceError
from services.kit.pixels import BitDepth
from services.robot.body import Beginning, ImuReading
from services.robot.clock import now_s
from services.robot.gate import MAX_AGE_S
from services.robot.real import BY_HAND, RealView
from services.ros2.config import Ros2Config
from services.ros2.messages import MessageError
from services.ros2.senses import Frame, Senses, picture
from smal.camera import Camera

#: Readings of the inertial unit closer than this are the same; its messages have microseconds.
_SAME_S: Final = 2e-6
_log = logging.getLogger("ros2")


class Link(Protocol):
    """Connection to the base."""

    def send(self, ahead_m_s: float, turn_rad_s: float, robot_s: float | None) -> None:
        """Send a velocity and return at once; the robot's time is its stamp, if known."""

    def lacks(self) -> str | None:
        """Return what the base lacks to accept velocities, or None."""

    def detail(self) -> Detail:
        """Return the link's part of the status."""


class Ros2Body:
    """A real base as `services.robot.body.Body`.

    It moves while the camera and all required inputs (odometry, scanner, bumpers) are received. If
    a sensor forbids a movement, the movement fails: the robot then stands until a person has
    inspected it and armed it again. Velocities travel over the ``link``.
    """

    def __init__(
        self, config: Ros2Config, senses: Senses, link: Link, clock: Callable[[], float] = now_s
    ) -> None:
        self.name = config.name
        self.kinematics = config.kinematics
        self.watchdog_s = config.watchdog_s
        self.braking_s = config.braking_s
        self._config = config
        self._camera = config.full(config.camera.topic)
        self._senses = senses
        self._link = link
        self._clock = clock
        self._frame: Frame | None = None
        self._jpeg = b""
        self._depth = BitDepth()
        self._begun_s = clock()
        self._felt_s = 0.0
        self._lacked = False
        self._asked = STANDING

    # Its scanner and bumpers forbid movements, see `drive`.
    frame_s = TICK_S
    conditions = BY_HAND
    mount = None

    @property
    def camera(self) -> Camera | None:
        """Camera model, as published by the camera."""
        return self._senses.camera

    def drive(self, velocity: Velocity) -> Velocity:
        """Drive at a velocity; stand while a required input is silent, ServiceError if forbidden."""
        for atom in velocity.keys:
            why = self._senses.forbids(atom)
            if why is not None:
                self.stand()
                raise ServiceError(
                    f"{self.name} must not move {atom}: {why}; it stands until it is armed"
                )
        self._asked = velocity
        if self._lacks() is not None:
            self._send(0.0, 0.0)
            return STANDING
        self._send(
            velocity.linear * self._config.speed_m_s,
            velocity.angular * self._config.turn_rate_rad_s,
        )
        return velocity

    def stand(self) -> None:
        """Stop until the next `drive`."""
        self._asked = STANDING
        self._send(0.0, 0.0)

    def _send(self, ahead_m_s: float, turn_rad_s: float) -> None:
        offset_s = self._senses.camera_clock.offset_s
        self._link.send(
            ahead_m_s, turn_rad_s, None if offset_s is None else self._clock() - offset_s
        )

    def _lacks(self) -> str | None:
        return self._link.lacks() or self._senses.silent(*self._asked.keys)

    def begin(self, request: ResetRequest) -> Beginning:
        """Prepare an episode; ServiceError if inputs are silent or the request is unsupported."""
        fit = "dialect, domain, namespace, distribution and the topics' names (ros2 topic list)"
        hint = f"does {self._config.router} reach it, and do {fit} fit?"
        frame = self._senses.frame
        if frame is None:
            raise ServiceError(f"{self.name}: no image received from {self._camera}; {hint}")
        age_s = self._clock() - frame.captured_s
        if age_s > MAX_AGE_S:
            raise ServiceError(
                f"{self.name}: the last image of {self._camera} is {age_s:.1f} s old"
            )
        lacks = self._lacks()
        if lacks is not None:
            reason = lacks if lacks == self._senses.learning() else f"{lacks}; {hint}"
            raise ServiceError(f"{self.name}: {reason}")
        self._begun_s = self._felt_s = self._clock()
        self._senses.touched = False
        self._senses.imu_since_last()
        self._frame = None
        self._senses.track.begin(frame.captured_s)
        return Beginning()

    def look(self, tick: int) -> RealView:
        """Return the newest frame and its readings; without a required input no frame is new."""
        del tick
        lacks = self._lacks()
        if lacks is not None and not self._lacked:
            _log.warning("%s stands: %s", self.name, lacks)
        elif lacks is None and self._lacked:
            _log.info("%s: required topics are back", self.name)
        self._lacked = lacks is not None
        self._take_newest()
        assert self._frame is not None  # noqa: S101 - begin has seen one, and _take_newest would have raised
        captured_s = self._frame.captured_s
        odometry = self._senses.track.reading(captured_s)
        if self._senses.silent() is not None:
            captured_s = min(captured_s, self._clock() - MAX_AGE_S)
        return RealView(self._jpeg, captured_s, self._senses.touched, odometry, self._imu())

    def peek(self) -> bytes | None:
        """Return the newest image, as JPEG; None while the camera is silent."""
        frame = self._senses.frame
        with suppress(MessageError):
            return (
                picture(frame.message, self._depth)
                if frame and self._clock() - frame.captured_s <= MAX_AGE_S
                else None
            )
        return None

    def _take_newest(self) -> None:
        frame = self._senses.frame
        if frame is None or frame is self._frame:
            return
        try:
            self._jpeg = picture(frame.message, self._depth)
            self._frame = frame
        except MessageError as error:
            self._senses.refuse(self._camera, str(error))
            if self._frame is None:
                raise ServiceError(f"{self.name}: {self._camera}: {error}") from None

    def _imu(self) -> tuple[ImuReading, ...] | None:
        if self._config.imu is None:
            return None
        new = []
        for one in self._senses.imu_since_last():
            if one.after_s > self._felt_s + _SAME_S:
                self._felt_s = one.after_s
                new.append(one._replace(after_s=one.after_s - self._begun_s))
        return tuple(new)

    def detail(self) -> Detail:
        """Return the state of the inputs, and the robot's clock relative to this machine's `date`."""
        clock = self._senses.camera_clock
        frame = self._senses.frame
        now = self._clock()
        offset_s = clock.offset_s
        return {
            "lacks": self._lacks(),
            "camera_age_s": None
            if frame is None or clock.delay_s == math.inf
            else round(now - frame.captured_s, 3),
            "camera_delay_s": None if clock.delay_s == math.inf else round(clock.delay_s, 3),
            "robot_clock_ahead_s": None
            if offset_s is None
            else round(now - offset_s - time.time(), 3),
            "camera_clock_leaps": clock.leaps,
            "odometry_leaps": self._senses.track.leaps,
            **{f"refused {topic}": count for topic, count in list(self._senses.refused.items())},
            **self._link.detail(),
        }

"""What the simulated robot saw and felt at one moment; its pictures are rendered when they are asked for."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from schemas.base import Message
from schemas.depth_image import DepthImage
from schemas.overhead_image import Calibration, OverheadImage
from schemas.pose import Pose as PoseMessage
from schemas.topics import DEPTH, OVERHEAD, Topic
from services.kit.jpeg import decode_jpeg, encode_jpeg
from services.robot.body import ImuReading, OdometryReading
from services.simulator.camera import Camera, blur, exposure, hazy
from services.simulator.sensors import Tilt
from services.simulator.variation import Variation
from services.simulator.world.place import OverheadMount, Pose, World

#: Fraction of the image that the victim must fill to be seen.
VISIBLE_FRACTION: Final = 0.0005
# Largest depth image, pixels, and the farthest depth that is told: 16 bits of millimetres end there.
_MOST_COLUMNS, _MOST_ROWS = 320, 240
_FARTHEST_M: Final = 65.0


class Eye(NamedTuple):
    """What is looked at, with what, and under which conditions."""

    world: World
    camera: Camera
    variation: Variation


@dataclass(frozen=True, eq=False)
class SimulatedView:
    """One moment of the simulated robot, as `services.robot.body.View` asks for it."""

    eye: Eye
    """What its pictures are made with."""
    pose: Pose
    """Where the robot truly is."""
    tilt: Tilt
    tilt_rate: Tilt
    """How the camera shakes."""
    contact: bool
    """Whether the robot has touched anything since the reset."""
    odometry: OdometryReading
    imu: tuple[ImuReading, ...]
    captured_s: float = 0.0
    """When, by the actuator's clock."""
    wanted: Callable[[Topic], bool] = lambda _topic: False
    """Whether anybody listens to a topic whose messages are costly."""

    @cached_property
    def jpeg(self) -> bytes:
        """What the camera tells, as JPEG."""
        return encode_jpeg(self._rendered())

    @cached_property
    def image(self) -> NDArray[np.uint8]:
        """What the camera tells, (height, width, 3) uint8 RGB: what is decoded of its JPEG."""
        return decode_jpeg(self.jpeg)

    def _rendered(self) -> NDArray[np.uint8]:
        """Return what the camera sees, blurred as far as it shakes."""
        _, camera, variation = self.eye
        image = camera.render(self.pose, self.tilt)
        if variation.visibility_m is not None:
            image = hazy(image, self.depth_m, variation.visibility_m, variation.light.horizon)
        image = blur(image, self.tilt_rate, camera.focal_px)
        if variation.exposure_ev:
            image = np.asarray(cv2.LUT(image, exposure(variation.exposure_ev)), dtype=np.uint8)
        return image

    @cached_property
    def depth_m(self) -> NDArray[np.float32]:
        """How far along the camera's axis each pixel of its image is, (height, width) metres or `inf`."""
        return self.eye.camera.depth_m(self.pose, self.tilt)

    @cached_property
    def overhead(self) -> NDArray[np.uint8]:
        """What the camera above the scene sees, (height, width, 3) RGB; a `LookupError` where there is none."""
        return self.eye.camera.overhead(self.pose)

    @cached_property
    def victim_found(self) -> bool:
        """Whether the victim is near and in view; the image is only searched when near."""
        world = self.eye.world
        away = math.hypot(world.victim.x - self.pose.x, world.victim.y - self.pose.y)
        near = away <= world.scale.found_m
        return near and self.eye.camera.victim_pixels(self.pose, self.tilt) >= VISIBLE_FRACTION

    def more(self, header: Message, made: Collection[str] = ()) -> Iterator[Message]:
        """Make the message of the true pose, and those of pictures that are costly and seldom listened to."""
        if PoseMessage.topic not in made:
            yield PoseMessage.after(header, x_m=self.pose.x, y_m=self.pose.y, heading_rad=self.pose.heading)
        if DEPTH.name not in made and self.wanted(DEPTH):
            yield depth_message(header, self.depth_m)
        mount = self.eye.world.place.overhead
        if OVERHEAD.name not in made and mount is not None and self.wanted(OVERHEAD):
            yield overhead_message(header, self.overhead, mount)


def depth_message(header: Message, depth_m: NDArray[np.float32]) -> DepthImage:
    """Make the message of a depth image (height, width) in metres, `inf` where nothing is.

    It has every n-th pixel, so that it is small.
    """
    height, width = depth_m.shape
    every = max(1, math.ceil(width / _MOST_COLUMNS), math.ceil(height / _MOST_ROWS))
    # From the middle of each block, so that a pixel of the small image looks where its block does.
    coarse = depth_m[every // 2 :: every, every // 2 :: every]
    near = np.where(coarse <= _FARTHEST_M, coarse, 0.0)
    rows, columns = near.shape
    return DepthImage.after(header, width=columns, height=rows, data=np.rint(1000 * near).astype("<u2").tobytes())


def overhead_message(header: Message, image: NDArray[np.uint8], mount: OverheadMount) -> OverheadImage:
    """Make the message of the overhead camera's image, (height, width, 3), with how that camera sees."""
    height, width, _ = image.shape
    calibration = Calibration(
        focal_px=mount.focal_px, centre_x_px=width / 2, centre_y_px=height / 2, x_m=mount.x_m, y_m=mount.y_m,
        height_m=mount.height_m, up_rad=math.remainder(math.radians(mount.up_deg), math.tau),
    )  # fmt: skip
    return OverheadImage.after(header, width=width, height=height, data=encode_jpeg(image), calibration=calibration)


class FindVictim:
    """The task of every simulated world: the victim is near, and in view."""

    def reached(self, view: SimulatedView) -> bool:
        """Return whether a frame shows it so."""
        return view.victim_found

"""The robot's camera: settings, image effects (haze, blur, exposure), and views."""

import math
import zlib
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Final, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from schemas.base import Message
from schemas.camera import Calibration, DepthImage, Mounting, OverheadImage
from schemas.motion import TruePose
from schemas.topics import DEPTH, OVERHEAD, Topic
from services.kit.jpeg import decode_jpeg, encode_jpeg
from services.robot.body import ImuReading, OdometryReading
from services.simulator.sensors.depth import measured
from services.simulator.sensors.readings import Tilt
from services.simulator.variation import DAY, Daylight, Variation
from services.simulator.world.place import OverheadMount, Pose, World
from smal.obstacles.clearance import Mount

FIELD_OF_VIEW_DEG: Final = 75.0  # Horizontal field of view.
# Focal length in image widths.
FOCAL: Final = 0.5 / math.tan(math.radians(FIELD_OF_VIEW_DEG) / 2)
# Exposure time of an image; motion during it blurs the image.
_EXPOSURE_S: Final = 0.02
# Smallest visible motion of a pixel.
_LEAST_PX: Final = 0.25
# Step between averaged images, pixels; interpolation hides it.
_STEP_PX: Final = 1.5
# Koschmieder: at the visibility, 5 % of the contrast is left.
_CONTRAST_AT_VISIBILITY: Final = 0.05
VISIBLE_FRACTION: Final = 0.0005  # Minimum fraction of the image that a visible victim fills.


@dataclass(frozen=True)
class CameraSettings:
    """Image size in pixels, light, and changes of the mounting, which the robot is not told."""

    width: int = 320
    height: int = 240
    light: Daylight = DAY.light
    pitch_deg: float = 0.0  # Downwards.
    raised_m: float = 0.0
    zoom: float = 1.0  # Factor of the focal length.


def blur(image: NDArray[np.uint8], rate: Tilt, focal_px: float) -> NDArray[np.uint8]:
    """Blur an image by the camera's rotation: the mean along the path of every pixel.

    Yaw to the left shifts the image (height, width, 3) to the right, a downward pitch shifts it up,
    and roll rotates it about its middle. For such small angles this holds at every depth. Edges are
    continued outwards. Without visible motion the image is returned unchanged.
    """
    height, width = image.shape[:2]
    turn_rad, down_rad, left_rad = (_EXPOSURE_S * angle for angle in rate)
    right_px = focal_px * left_rad
    down_px = -focal_px * down_rad
    longest_px = math.hypot(right_px, down_px) + abs(turn_rad) * math.hypot(width, height) / 2
    if longest_px < _LEAST_PX:
        return image
    count = math.ceil(longest_px / _STEP_PX) + 1
    total = np.zeros(image.shape, dtype=np.float32)
    for part in (np.arange(count) + 0.5) / count - 0.5:
        affine = cv2.getRotationMatrix2D(
            ((width - 1) / 2, (height - 1) / 2), math.degrees(part * turn_rad), 1.0
        )
        affine[:, 2] += part * right_px, part * down_px
        moved = cv2.warpAffine(image, affine, (width, height), borderMode=cv2.BORDER_REPLICATE)
        cv2.accumulate(moved, total)
    return np.rint(total / count).astype(np.uint8)


def hazy(
    image: NDArray[np.uint8],
    depth_m: NDArray[np.float32],
    visibility_m: float,
    colour: tuple[float, float, float],
) -> NDArray[np.uint8]:
    """Add haze (Koschmieder's law) to an image (h, w, 3).

    `depth_m` has shape (h, w), in metres, with infinity for the sky; `colour` is the haze's RGB.
    """
    through = np.exp(depth_m * np.float32(np.log(_CONTRAST_AT_VISIBILITY) / visibility_m))[
        ..., None
    ]
    veiled = image * through + np.asarray(colour, dtype=np.float32) * (1 - through)
    return np.asarray(np.rint(veiled), dtype=np.uint8)


@lru_cache(maxsize=16)
def exposure(stops: float) -> NDArray[np.uint8]:
    """Return a table (256,) that exposes sRGB by `stops` more (IEC 61966-2-1)."""
    encoded = np.arange(256) / 255
    linear = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
    brighter = np.clip(linear * 2.0**stops, 0, 1)
    again = np.where(brighter <= 0.0031308, brighter * 12.92, 1.055 * brighter ** (1 / 2.4) - 0.055)
    return np.asarray(np.rint(255 * again), dtype=np.uint8)


def noisy(image: NDArray[np.uint8], deviation: float) -> NDArray[np.uint8]:
    """Add noise of a standard deviation (levels) to an image; equal images get equal noise."""
    rng = np.random.default_rng(zlib.crc32(image.tobytes()))
    noise = deviation * rng.standard_normal(image.shape, dtype=np.float32)
    return np.clip(np.rint(image + noise), 0, 255).astype(np.uint8)


class Lens(Protocol):
    """Interface of a renderer of a world."""

    @property
    def focal_px(self) -> float:
        """Focal length, pixels."""

    def walk(self, people: tuple[Pose, ...]) -> None:
        """Set the poses of the people."""

    def render(self, pose: Pose, tilt: Tilt) -> NDArray[np.uint8]:
        """Render the image (height, width, 3), RGB."""

    def depth_m(self, pose: Pose, tilt: Tilt) -> NDArray[np.float32]:
        """Render the depth (height, width) along the optical axis, metres or infinity."""

    def overhead(self, pose: Pose) -> NDArray[np.uint8]:
        """Render the image of the overhead camera with the robot at a pose."""

    def victim_pixels(self, pose: Pose, tilt: Tilt) -> float:
        """Return the fraction of the image that the victim fills."""


@dataclass(frozen=True, eq=False)
class SimulatedView:
    """One moment of the simulated robot, an implementation of `services.robot.body.View`."""

    world: World
    lens: Lens
    variation: Variation
    pose: Pose  # Ground truth.
    tilt: Tilt
    tilt_rate: Tilt  # Shake of the camera.
    contact: bool  # Whether the robot has touched an obstacle since the reset.
    odometry: OdometryReading
    imu: tuple[ImuReading, ...]
    victim: Pose | None  # Ground truth.
    people: tuple[Pose, ...]  # Ground truth.
    mount: Mount | None  # Mounting of the depth camera, if present.
    captured_s: float = 0.0  # Capture time on the actuator's clock.
    wanted: Callable[[Topic], bool] = lambda _topic: False
    """Returns whether a topic has subscribers; checked for expensive messages."""

    @property
    def true_pose(self) -> tuple[float, float, float]:
        """Ground truth: x, y in metres, heading in radians."""
        return self.pose.x, self.pose.y, self.pose.heading

    @property
    def camera(self) -> Lens:
        """The camera, with the people at their positions of this moment."""
        self.lens.walk(self.people)
        return self.lens

    @cached_property
    def jpeg(self) -> bytes:
        """Camera image as JPEG."""
        return encode_jpeg(self._rendered())

    @cached_property
    def image(self) -> NDArray[np.uint8]:
        """Camera image (height, width, 3), uint8 RGB, decoded from its JPEG."""
        return decode_jpeg(self.jpeg)

    def _rendered(self) -> NDArray[np.uint8]:
        camera = self.camera
        variation = self.variation
        image = camera.render(self.pose, self.tilt)
        if variation.visibility_m is not None:
            image = hazy(image, self.depth_m, variation.visibility_m, variation.light.horizon)
        image = blur(image, self.tilt_rate, camera.focal_px)
        if variation.defocus:
            sigma_px = variation.defocus * image.shape[1] / 1000
            image = np.asarray(cv2.GaussianBlur(image, (0, 0), sigma_px), dtype=np.uint8)
        if variation.exposure_ev:
            image = np.asarray(cv2.LUT(image, exposure(variation.exposure_ev)), dtype=np.uint8)
        if variation.noise:
            image = noisy(image, variation.noise)
        return image

    @cached_property
    def depth_m(self) -> NDArray[np.float32]:
        """Depth of each pixel along the optical axis, (height, width), metres or `inf`."""
        return self.camera.depth_m(self.pose, self.tilt)

    @cached_property
    def depth(self) -> NDArray[np.float32] | None:
        """Measurement of the depth camera, a smaller image, metres; 0 where invalid."""
        return None if self.mount is None else measured(self.depth_m, self.mount.focal)

    @cached_property
    def overhead(self) -> NDArray[np.uint8]:
        """Image of the overhead camera, (height, width, 3); LookupError without it."""
        return self.camera.overhead(self.pose)

    @cached_property
    def victim_found(self) -> bool:
        """Whether the victim is near and in view; the image is rendered only near the victim."""
        near = self.victim is not None and self.near(self.victim)
        return near and self.camera.victim_pixels(self.pose, self.tilt) >= VISIBLE_FRACTION

    def near(self, place: Pose) -> bool:
        """Return whether a place is within the distance of a found victim."""
        return math.hypot(place.x - self.pose.x, place.y - self.pose.y) <= self.world.scale.found_m

    def more(self, header: Message, made: Collection[str] = ()) -> Iterator[Message]:
        """Yield the true pose, and the images that have subscribers, except messages in `made`."""
        if TruePose.topic not in made:
            yield TruePose.after(
                header, x_m=self.pose.x, y_m=self.pose.y, heading_rad=self.pose.heading
            )
        if (
            DEPTH.name not in made
            and self.mount is not None
            and self.depth is not None
            and self.wanted(DEPTH)
        ):
            yield depth_message(header, self.depth, self.mount)
        above = self.world.place.overhead
        if OVERHEAD.name not in made and above is not None and self.wanted(OVERHEAD):
            yield overhead_message(header, self.overhead, above)


def depth_message(header: Message, depth_m: NDArray[np.float32], mount: Mount) -> DepthImage:
    """Build the message of a depth image (height, width), metres, 0 where invalid."""
    rows, columns = depth_m.shape
    millimetres = np.rint(1000 * depth_m).astype("<u2").tobytes()
    return DepthImage.after(
        header, width=columns, height=rows, data=millimetres, mounting=Mounting(**mount._asdict())
    )


def overhead_message(
    header: Message, image: NDArray[np.uint8], mount: OverheadMount
) -> OverheadImage:
    """Build the message of an overhead image (height, width, 3) with its calibration."""
    height, width, _ = image.shape
    calibration = Calibration(
        focal_px=mount.focal_px, centre_x_px=width / 2, centre_y_px=height / 2, x_m=mount.x_m, y_m=mount.y_m,
        height_m=mount.height_m, up_rad=math.remainder(math.radians(mount.up_deg), math.tau),
    )  # fmt: skip
    return OverheadImage.after(
        header, width=width, height=height, data=encode_jpeg(image), calibration=calibration
    )


class FindVictim:
    """Task of every simulated world: reach the victim, or the places that an operator marked."""

    def __init__(self) -> None:
        # By world, its victim and the goal.
        self._marked: dict[tuple[str, Pose, str], list[Pose]] = {}

    def reached(self, view: SimulatedView, goal: str = "victim") -> bool:
        """Return whether the view shows the goal reached."""
        places = self._marked.get((view.world.name, view.world.victim, goal))
        return view.victim_found if places is None else any(map(view.near, places))

    def gone(self, view: SimulatedView, goal: str) -> bool:
        """Return whether the victim is absent."""
        key = (view.world.name, view.world.victim, goal)
        return view.victim is None and key not in self._marked

    def told(self, view: SimulatedView, goal: str) -> None:
        """Add a goal that an operator marked."""
        key = (view.world.name, view.world.victim, goal)
        self._marked.setdefault(key, []).append(view.pose)

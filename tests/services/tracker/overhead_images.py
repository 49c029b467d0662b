"""Images of a tagged robot from above, by a projection of their own."""

import math
from dataclasses import dataclass

import cv2
import numpy as np

from schemas.camera import Calibration
from services.tracker.tag_tracking import Tag

SUPERSAMPLING = 8  # What a pixel is averaged from, along each axis.
MARGIN_CELLS = 1.0


@dataclass(frozen=True)
class Shot:
    """How an image is taken: size, pose (x, y, heading) of the tag, and what spoils the picture."""

    camera: Calibration
    size: tuple[int, int]
    pose: tuple[float, float, float]
    blur_px: float = 0.6
    noise: float = 3.0
    seed: int = 0


def homography(camera: Calibration, height_m: float) -> np.ndarray:
    """Return the 3x3 matrix from (x, y, 1) on the plane at a height to pixels: K R [I | -C] of a pinhole camera."""
    cos = math.cos(camera.up_rad)
    sin = math.sin(camera.up_rad)
    rotation = np.array([[sin, -cos, 0.0], [-cos, -sin, 0.0], [0.0, 0.0, -1.0]])
    k = np.array(
        [
            [camera.focal_px, 0, camera.centre_x_px],
            [0, camera.focal_px, camera.centre_y_px],
            [0, 0, 1.0],
        ]
    )
    plane = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, height_m]])
    plane[:, 2] -= (camera.x_m, camera.y_m, camera.height_m)
    return k @ rotation @ plane


def pixel(camera: Calibration, x_m: float, y_m: float, height_m: float) -> np.ndarray:
    """Return where a point is in the image."""
    seen = homography(camera, height_m) @ (x_m, y_m, 1.0)
    return seen[:2] / seen[2]


def photograph(shot: Shot, *tags: Tag, cover: np.ndarray | None = None) -> np.ndarray:
    """Return the uint8 image (height, width, 3): robots with tags on a mottled floor.

    Parameters
    ----------
    tags
        All at the shot's pose, each next one a metre further east.
    cover
        Corners (n, 2), metres in the first tag's frame (ahead, left), of something grey that lies on it.
    """
    width, height = shot.size
    random = np.random.default_rng(shot.seed)
    mottles = random.normal(130.0, 12.0, (height // 8 + 1, width // 8 + 1))
    picture = cv2.resize(mottles, (width, height), interpolation=cv2.INTER_CUBIC)
    x, y, heading = shot.pose
    for number, tag in enumerate(tags):
        _put(picture, shot.camera, tag, (x + number, y, heading), cover if number == 0 else None)
    picture = cv2.GaussianBlur(picture, (0, 0), shot.blur_px)
    picture = picture[:, :, np.newaxis] + random.normal(0.0, shot.noise, (height, width, 3))
    return np.clip(np.rint(picture), 0, 255).astype(np.uint8)


def _put(
    picture: np.ndarray,
    camera: Calibration,
    tag: Tag,
    pose: tuple[float, float, float],
    cover: np.ndarray | None,
) -> None:
    """Draw one robot: every pixel is the mean of what its supersamples see on the tag's plane."""
    middle = pixel(camera, pose[0], pose[1], tag.height_m)
    reach = math.ceil(tag.side_m * camera.focal_px / (camera.height_m - tag.height_m)) + 2
    height, width = picture.shape
    left, upper = np.clip(np.floor(middle).astype(int) - reach, 0, (width, height))
    right, lower = np.clip(np.floor(middle).astype(int) + reach, 0, (width, height))
    if left >= right or upper >= lower:
        return
    u = left + (np.arange((right - left) * SUPERSAMPLING) + 0.5) / SUPERSAMPLING
    v = upper + (np.arange((lower - upper) * SUPERSAMPLING) + 0.5) / SUPERSAMPLING
    pixels = np.stack([*np.meshgrid(u, v), np.ones((len(v), len(u)))], axis=-1)
    seen = pixels @ np.linalg.inv(homography(camera, tag.height_m)).T
    x = seen[..., 0] / seen[..., 2] - pose[0]
    y = seen[..., 1] / seen[..., 2] - pose[1]
    cos = math.cos(pose[2])
    sin = math.sin(pose[2])
    ahead = x * cos + y * sin
    leftward = y * cos - x * sin
    background = np.kron(picture[upper:lower, left:right], np.ones((SUPERSAMPLING, SUPERSAMPLING)))
    drawn = _robot(background, ahead, leftward, tag)
    if cover is not None:
        drawn[_inside(cover, ahead, leftward)] = 120.0
    cells = drawn.reshape(lower - upper, SUPERSAMPLING, right - left, SUPERSAMPLING)
    picture[upper:lower, left:right] = cells.mean(axis=(1, 3))


def _robot(background: np.ndarray, ahead: np.ndarray, left: np.ndarray, tag: Tag) -> np.ndarray:
    """Return the brightness of a dark round robot with a white card on it, and the marker on the card."""
    marker = cv2.aruco.generateImageMarker(
        cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50), tag.number, 6
    )
    cell = tag.side_m / 6
    card = tag.side_m / 2 + MARGIN_CELLS * cell
    drawn = np.where(np.hypot(ahead, left) < 0.9 * tag.side_m, 45.0, background)
    drawn[(np.abs(ahead) < card) & (np.abs(left) < card)] = 225.0
    row = np.floor((tag.side_m / 2 - ahead) / cell).astype(int)
    column = np.floor((tag.side_m / 2 - left) / cell).astype(int)
    on = (row >= 0) & (row < 6) & (column >= 0) & (column < 6)
    drawn[on] = np.where(marker[row[on], column[on]] > 0, 225.0, 30.0)
    return drawn


def _inside(polygon: np.ndarray, ahead: np.ndarray, left: np.ndarray) -> np.ndarray:
    """Return which points are inside a convex polygon given anticlockwise."""
    inside = np.ones(ahead.shape, dtype=bool)
    for (a0, l0), (a1, l1) in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
        inside &= (a1 - a0) * (left - l0) - (l1 - l0) * (ahead - a0) >= 0
    return inside

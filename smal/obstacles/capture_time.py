"""Capture time of a depth image, estimated from its content: its stamp can be wrong.

A camera that hangs repeats an image, which is as old as at its first delivery. A slow driver delivers old images under
fresh stamps, which show obstacles as seen from an earlier pose. Therefore the robot's recent odometry poses are the
hypotheses. Each hypothesis predicts the points of an earlier image, and the image contradicts the wrong hypotheses
(scan matching, as in Olson 2009, over a handful of poses). A hidden Markov model accumulates the evidence, because a
delay usually lasts. While the robot stands, all hypotheses predict the same. The belief then returns within seconds to
the prior of an unknown camera, so that a robot which was wrongly classified as late can drive again.
"""

import math
from collections import deque
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
from scipy.ndimage import maximum_filter, minimum_filter

from smal.arrays import Float32s, Floats
from smal.movement import placed, seen_from
from smal.obstacles.clearance import Mount, above_ground, rays, thinned

#: Longest delay among the hypotheses, seconds. A longer one counts as this: both are too old for driving.
LONGEST_S: Final = 1.0
#: Delay that counts as none: the usual latency of cameras.
PROMPT_S: Final = 0.1
#: Poses that differ by less are equal: a tenth of the way between two frames, and of the turn.
STILL_M = 0.01
STILL_RAD = math.radians(0.5)
#: A measured depth that differs from the prediction by more than this share contradicts it. It is twice the error of
#: stereo cameras, which is 2 % at 4 m, and grows with the distance.
DIFFERS: Final = 0.05
DIFFERS_A_M: Final = 0.01
#: Pointing error of the camera, for example on a mast that shakes.
SHAKES_RAD: Final = math.radians(1.5)
#: Maximum number of compared points of an image, and the minimum for any evidence.
POINTS = 1000
FEW = 50
#: Weight of a mean cost of 1, in natural logarithms. Neighbouring points err alike: a thousand are about twenty.
EVIDENCE: Final = 20.0
#: Probability, for each new image, that the delay changes: cameras work for hours. The new delay has the prior of an
#: unknown camera, which is fresh with the probability `FRESH`.
CHANGES: Final = 0.02
FRESH: Final = 0.95
#: Likelihood of an image that is unrelated to earlier ones: the robot was carried, or the scene has moved. It equals a
#: mean cost of a quarter, which no true hypothesis has.
UNRELATED: Final = math.exp(-EVIDENCE / 4.0)
#: Probability that a camera which hung has queued its images, instead of dropping them.
QUEUES: Final = 0.4


class PastImage(NamedTuple):
    """An earlier image: its points above the ground (n, 3), ahead, left and up of the camera, and its pose."""

    points: Floats
    pose: Floats
    at_s: float


class CaptureTime:
    """Estimates the robot's pose at which each depth image was taken."""

    def __init__(self, mount: Mount) -> None:
        self._mount = mount
        #: Times and poses, the newest first.
        self._track: deque[tuple[float, Floats]] = deque()
        #: Probability that a new image was taken at each of these.
        self._belief = np.empty(0)
        #: The newest last.
        self._past: deque[PastImage] = deque()
        self._last: Float32s | None = None
        #: Time and pose of the last image.
        self._taken = -math.inf, np.zeros(3)
        #: Pose at its first delivery.
        self._delivered = np.zeros(3)
        #: Number of deliveries since.
        self._repeats = 0

    def estimate(self, depth_m: Float32s) -> tuple[float, Sequence[float]]:
        """Return the capture time and pose of an image that is delivered at the last noted pose.

        Parameters
        ----------
        depth_m : array (height, width)
            Metres; 0, NaN or infinity for missing values.

        Returns
        -------
        (float, (3,))
            Seconds, and the odometry pose at that time.
        """
        at_s, pose = self._track[0]
        repeated = self._last is not None and np.array_equal(depth_m, self._last, equal_nan=True)
        if repeated and _apart(pose, self._delivered):
            self._repeats += 1
        else:
            # For a robot that stands, a repeated image is as good as a new one.
            if not repeated:
                self._last = depth_m.copy()
                self._delivered = pose
            self._resume()
            self._take(depth_m, at_s)
        taken_s, taken_pose = self._taken
        return taken_s, tuple(taken_pose)

    def _take(self, depth_m: Float32s, at_s: float) -> None:
        """Estimate the pose of a new image, and store its points."""
        small_m, _ = thinned(depth_m)
        self._weigh(small_m)
        self._taken = self._track[self._best()]
        self._past.append(PastImage(_points(small_m, self._mount), self._taken[1], at_s))
        while self._past[0].at_s < at_s - LONGEST_S:
            self._past.popleft()

    def note(self, pose: Sequence[float], at_s: float) -> None:
        """Store the odometry pose at a time: x and y in metres, heading in radians, finite.

        Every frame has a pose, and optionally an image. The delay of new images stays constant in frames.
        """
        self._track.appendleft((at_s, np.asarray(pose, dtype=np.float64)))
        first = 0.0 if self._belief.size else 1.0
        self._belief = np.append(self._belief, first)
        while len(self._track) > 1 and self._track[-1][0] < at_s - LONGEST_S:
            self._track.pop()
            oldest = self._belief[-2:].sum()
            self._belief = np.append(self._belief[:-2], oldest)

    def _best(self) -> int:
        """Return the most likely hypothesis; a prompt image counts as fresh."""
        now_s, _ = self._track[0]
        prompt = np.array([now_s - at_s <= PROMPT_S + 1e-9 for at_s, _ in self._track])
        if self._belief[prompt].sum() >= self._belief.max():
            return 0
        return int(self._belief.argmax())

    def _resume(self) -> None:
        """Expect the image after a hang to be fresh, or late by the hang."""
        late = np.zeros_like(self._belief)
        frames = min(self._repeats, self._belief.size - 1)
        late[frames:] = self._belief[: late.size - frames]
        late[-1] += 1.0 - late.sum()
        self._belief = (1.0 - QUEUES) * self._belief + QUEUES * late
        self._repeats = 0

    def _weigh(self, depth_m: Float32s) -> None:
        """Weigh the hypotheses by a new image."""
        poses = np.array([pose for _, pose in self._track])
        if not self._past or len(poses) == 1:
            return
        any_delay = np.full(len(poses), (1.0 - FRESH) / (len(poses) - 1))
        any_delay[0] = FRESH
        self._belief = (1.0 - CHANGES) * self._belief + CHANGES * any_delay
        if not any(_apart(pose, poses[0]) for pose in poses[1:]):
            return
        ranges = _ranges(depth_m, self._mount.focal)
        costs = np.array([_cost(ranges, self._past[0], pose, self._mount) for pose in poses])
        if np.isfinite(costs).all():
            self._belief *= np.exp(-EVIDENCE * costs) + UNRELATED
            self._belief /= self._belief.sum()


def _apart(one: Floats, other: Floats) -> bool:
    turned = abs(math.remainder(one[2] - other[2], math.tau))
    distance = math.hypot(one[0] - other[0], one[1] - other[1])
    return distance > STILL_M or turned > STILL_RAD


def _points(depth_m: Float32s, mount: Mount) -> Floats:
    """Return points of an image above the ground, (n, 3): ahead, left and up of the camera."""
    rows, columns = depth_m.shape
    every = max(1, math.ceil(math.sqrt(rows * columns / POINTS)))
    ahead = depth_m[every // 2 :: every, every // 2 :: every].astype(np.float64)
    below, left = rays(depth_m.shape, every, mount.focal)
    down, across = np.meshgrid(below, left, indexing="ij")
    stands = np.isfinite(ahead) & (ahead > 0.0)
    height = mount.height_m - ahead[stands] * down[stands]
    stands[stands] = above_ground(height, ahead[stands])
    ahead = ahead[stands]
    return np.stack([ahead, ahead * across[stands], -ahead * down[stands]], axis=1)


def _ranges(depth_m: Float32s, focal: float) -> tuple[Floats, Floats]:
    """Return the nearest and the farthest depth around each pixel, within `SHAKES_RAD`; 0 for missing values."""
    valid = np.isfinite(depth_m) & (depth_m > 0.0)
    size = 2 * math.ceil(SHAKES_RAD * focal * depth_m.shape[1]) + 1
    nearest = minimum_filter(np.where(valid, depth_m, np.inf), size)
    farthest = maximum_filter(np.where(valid, depth_m, 0.0), size)
    return np.where(valid, nearest, 0.0), np.where(valid, farthest, 0.0)


def _cost(ranges: tuple[Floats, Floats], before: PastImage, pose: Floats, mount: Mount) -> float:
    """Return how far an image contradicts a pose, 0 to 1, by the points of an earlier image; NaN for too few points.

    Neighbouring pixels of a slanted surface have different depths. A prediction between these is no error.
    """
    ahead, left, up = before.points.T
    offsets = np.stack([ahead + mount.ahead_m, left, np.zeros(ahead.size)], axis=1)
    points = seen_from(placed(offsets, before.pose), pose)
    ahead = points[:, 0] - mount.ahead_m
    left = points[:, 1]
    rows, columns = ranges[0].shape
    focal = mount.focal * columns
    with np.errstate(divide="ignore", invalid="ignore"):
        row = np.rint(rows / 2.0 - 0.5 - focal * up / ahead)
        column = np.rint(columns / 2.0 - 0.5 - focal * left / ahead)
        inside = (ahead > 0.0) & (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
    pixels = row[inside].astype(np.intp), column[inside].astype(np.intp)
    nearest, farthest = (depths[pixels] for depths in ranges)
    measured = (nearest > 0.0) & (nearest <= farthest)
    if measured.sum() < FEW:
        return math.nan
    predicted = ahead[inside][measured]
    within = predicted.clip(nearest[measured], farthest[measured])
    error = np.abs(np.log(predicted / within))
    tolerance = np.maximum(DIFFERS, DIFFERS_A_M * predicted)
    return float(np.minimum(error / tolerance, 1.0).mean())

"""When a depth image was taken, by what it shows: its stamp may lie.

A camera that hangs repeats an image, which is as old as at its first delivery. A slow driver delivers old images under
fresh stamps, and they show things where an earlier pose saw them. The robot's recent poses, by the wheels, are
therefore the hypotheses. Each of them predicts where the points of an earlier image are now, and the image contradicts
the wrong ones (scan matching, as in Olson 2009, over a handful of poses). A hidden Markov model adds the evidence up: a
delay usually lasts. While the robot stands, all hypotheses predict the same: the belief returns within seconds to that
of an unknown camera, so that a robot which was called late by mistake may drive again.
"""

import math
from collections import deque
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
from scipy.ndimage import maximum_filter, minimum_filter

from smal.arrays import Float32s, Floats
from smal.movement import placed, seen_from
from smal.obstacles.clearance import GRID_CONFIG, Mount, above_ground

#: Delays up to this one are hypotheses, seconds. A longer one counts as this: both are too old to drive by.
LONGEST_S: Final = 1.0
PROMPT_S: Final = 0.1  # Delay that is not told from none: cameras take about so long.
#: Two poses that differ by less show the same: a tenth of what the robot drives between two frames, and its turn.
STILL_M = 0.01
STILL_RAD = math.radians(0.5)
#: A measured depth that differs by more from the predicted one, as a share of it, contradicts the prediction: twice the
#: error of stereo cameras, which is 2 % at 4 m, and grows with the distance.
DIFFERS: Final = 0.05
DIFFERS_A_M: Final = 0.01
SHAKES_RAD: Final = math.radians(
    1.5
)  # How far the camera may look aside of where it sits, as on a mast that shakes.
#: Points of an image that are compared, at most, and the fewest that prove anything.
POINTS = 1000
FEW = 50
#: Weight of a mean cost of 1, in natural logarithms. Neighbouring points err alike: a thousand are about twenty.
EVIDENCE: Final = 20.0
#: Probability, with each new image, that the delay changed: cameras work for hours. It is then as likely any other as
#: that of a camera of which nothing is known, which is fresh with this probability.
CHANGES: Final = 0.02
FRESH: Final = 0.95
#: Likelihood of an image that has nothing to do with the earlier ones: the robot was carried, or what it saw has moved.
#: It is that of a mean cost of a quarter, which no true hypothesis has.
UNRELATED: Final = math.exp(-EVIDENCE / 4.0)
QUEUES: Final = (
    0.4  # Probability that a camera which hung has delayed its images, and not dropped them.
)


class Look(NamedTuple):
    """An earlier image: its points above the ground (n, 3), ahead, left and up of the camera, and its pose."""

    points: Floats
    pose: Floats
    at_s: float


class CaptureTime:
    """Estimates, image after image, at which of the robot's recent poses a depth image was taken."""

    def __init__(self, mount: Mount) -> None:
        self._mount = mount
        self._track: deque[tuple[float, Floats]] = deque()  # Times and poses, the newest first.
        self._belief = np.empty(0)  # Probability that a new image was taken at each of these.
        self._looks: deque[Look] = deque()  # The newest last.
        self._last: Float32s | None = None
        self._taken = -math.inf, np.zeros(3)  # Time and pose of the last image,
        self._delivered = self._taken  # and those of its first delivery to a robot that moves.
        self._repeats = 0  # How often it was delivered again since.

    def estimate(self, depth_m: Float32s) -> tuple[float, Sequence[float]]:
        """Return when and where an image was taken that is delivered at the last pose noted.

        Parameters
        ----------
        depth_m : array (height, width)
            Metres; 0, NaN or infinity where nothing was measured.

        Returns
        -------
        (float, (3,))
            Seconds, and the pose by the wheels then.
        """
        at_s, here = self._track[0]
        if self._last is None or not np.array_equal(depth_m, self._last, equal_nan=True):
            self._last = depth_m.copy()
            self._delivered = at_s, here
            self._resume()
            every = math.ceil(depth_m.shape[1] / GRID_CONFIG.depth_columns)
            small_m = depth_m[every // 2 :: every, every // 2 :: every]
            self._weigh(small_m)
            self._taken = self._track[self._best()]
            self._looks.append(Look(_points(small_m, self._mount), self._taken[1], at_s))
            while self._looks[0].at_s < at_s - LONGEST_S:
                self._looks.popleft()
        elif _apart(here, self._delivered[1]):
            self._repeats += 1
        else:  # A robot that stands sees the same: the image may as well be new.
            self._taken = at_s - (self._delivered[0] - self._taken[0]), self._taken[1]
            self._delivered = at_s, self._delivered[1]
        return self._taken[0], tuple(self._taken[1])

    def note(self, pose: Sequence[float], at_s: float) -> None:
        """Take the pose by the wheels at a time: x and y in metres, heading in radians, finite.

        A frame comes with a pose, and perhaps with an image. The delay of new images stays what it was, in frames.
        """
        here = np.asarray(pose, dtype=np.float64)
        self._track.appendleft((at_s, here))
        self._belief = np.append(self._belief, 0.0 if self._belief.size else 1.0)
        while len(self._track) > 1 and self._track[-1][0] < at_s - LONGEST_S:
            self._track.pop()
            self._belief = np.append(self._belief[:-2], self._belief[-2:].sum())

    def _best(self) -> int:
        """Return the likeliest hypothesis; a prompt image counts as fresh."""
        prompt = np.array([self._track[0][0] - at_s <= PROMPT_S + 1e-9 for at_s, _ in self._track])
        return 0 if self._belief[prompt].sum() >= self._belief.max() else int(self._belief.argmax())

    def _resume(self) -> None:
        """Expect of the image after a hang that it is fresh, or late by the hang."""
        late = np.zeros_like(self._belief)
        frames = min(self._repeats, self._belief.size - 1)
        late[frames:] = self._belief[: late.size - frames]
        late[-1] += 1.0 - late.sum()
        self._belief = (1.0 - QUEUES) * self._belief + QUEUES * late
        self._repeats = 0

    def _weigh(self, depth_m: Float32s) -> None:
        """Weigh the hypotheses by a new image."""
        poses = np.array([one for _, one in self._track])
        if not self._looks or len(poses) == 1:
            return
        any_delay = np.full(len(poses), (1.0 - FRESH) / (len(poses) - 1))
        any_delay[0] = FRESH
        self._belief = (1.0 - CHANGES) * self._belief + CHANGES * any_delay
        if not any(_apart(one, poses[0]) for one in poses[1:]):
            return
        ranges = _ranges(depth_m, self._mount.focal)
        costs = np.array([_cost(ranges, self._looks[0], one, self._mount) for one in poses])
        if np.isfinite(costs).all():
            self._belief *= np.exp(-EVIDENCE * costs) + UNRELATED
            self._belief /= self._belief.sum()


def _apart(one: Floats, other: Floats) -> bool:
    turned = abs(math.remainder(one[2] - other[2], math.tau))
    return math.hypot(one[0] - other[0], one[1] - other[1]) > STILL_M or turned > STILL_RAD


def _points(depth_m: Float32s, mount: Mount) -> Floats:
    """Return points of an image that stand above the ground, (n, 3): ahead, left and up of the camera."""
    rows, columns = depth_m.shape
    every = max(1, math.ceil(math.sqrt(rows * columns / POINTS)))
    row, column = np.mgrid[every // 2 : rows : every, every // 2 : columns : every]
    ahead = depth_m[row, column].astype(np.float64)
    left = -(column + 0.5 - columns / 2.0) / (mount.focal * columns)
    up = -(row + 0.5 - rows / 2.0) / (mount.focal * columns)
    stands = np.isfinite(ahead) & (ahead > 0.0)
    stands[stands] = above_ground(mount.height_m + ahead[stands] * up[stands], ahead[stands])
    return np.stack(
        [ahead[stands], ahead[stands] * left[stands], ahead[stands] * up[stands]], axis=1
    )


def _ranges(depth_m: Float32s, focal: float) -> tuple[Floats, Floats]:
    """Return the nearest and the farthest depth about each pixel, within `SHAKES_RAD`; 0 where it has none."""
    valid = np.isfinite(depth_m) & (depth_m > 0.0)
    size = 2 * math.ceil(SHAKES_RAD * focal * depth_m.shape[1]) + 1
    nearest = minimum_filter(np.where(valid, depth_m, np.inf), size)
    farthest = maximum_filter(np.where(valid, depth_m, 0.0), size)
    return np.where(valid, nearest, 0.0), np.where(valid, farthest, 0.0)


def _cost(ranges: tuple[Floats, Floats], before: Look, pose: Floats, mount: Mount) -> float:
    """Return how far an image contradicts a pose, 0 to 1, by the points of an earlier one; NaN if too few are in view.

    A surface that recedes has another depth in the next pixel. A prediction between those of neighbours is no error.
    """
    ahead, left, up = before.points.T
    offsets = np.stack([ahead + mount.ahead_m, left, np.zeros(ahead.size)], axis=1)
    there = seen_from(placed(offsets, before.pose), pose)
    ahead = there[:, 0] - mount.ahead_m
    left = there[:, 1]
    rows, columns = ranges[0].shape
    with np.errstate(divide="ignore", invalid="ignore"):
        row = np.rint(rows / 2.0 - 0.5 - mount.focal * columns * up / ahead)
        column = np.rint(columns / 2.0 - 0.5 - mount.focal * columns * left / ahead)
        inside = (ahead > 0.0) & (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
    pixels = row[inside].astype(np.intp), column[inside].astype(np.intp)
    predicted = ahead[inside]
    (nearest, farthest) = (one[pixels] for one in ranges)
    measured = (nearest > 0.0) & (nearest <= farthest)
    if measured.sum() < FEW:
        return math.nan
    predicted, nearest, farthest = (one[measured] for one in (predicted, nearest, farthest))
    error = np.abs(np.log(predicted / predicted.clip(nearest, farthest)))
    return float(np.minimum(error / np.maximum(DIFFERS, DIFFERS_A_M * predicted), 1.0).mean())

"""When a depth image was taken, by what it shows: its stamp may lie.

A camera that hangs repeats an image, and a slow driver delivers old images under fresh stamps. Both show things where
they were seen from an earlier pose. The robot's recent poses, by the wheels, are therefore the hypotheses. Each of them
predicts where the points of an earlier image are now, and the image contradicts the wrong ones (scan matching, as in
Olson 2009, over a handful of poses). A hidden Markov model adds the evidence up: a delay usually lasts. While the robot
stands, or where nothing stands in view, all hypotheses predict the same, and the belief stays as it was.
"""

import math
from collections import deque
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from smal.movement import placed, seen_from
from smal.obstacles.clearance import Floats, Mount, above_ground

#: Delays up to this one are hypotheses, seconds. A longer one counts as this: both are too old to drive by.
LONGEST_S: Final = 1.0
#: Two poses that differ by less show the same: a tenth of what the robot drives between two frames, and its turn.
STILL_M, STILL_RAD = 0.01, math.radians(0.5)
#: A measured depth that differs by more from the predicted one, as a share of it, contradicts the prediction: twice the
#: error of stereo cameras, which is 2 % at 4 m, and grows with the distance.
DIFFERS: Final = 0.05
DIFFERS_A_M: Final = 0.01
#: Points of an image that are compared, at most, and the fewest that tell anything.
POINTS, FEW = 1000, 50
#: Weight of a mean cost of 1, in natural logarithms. Neighbouring points err alike: a thousand are about twenty.
EVIDENCE: Final = 20.0
#: Probabilities, with each new image of a robot that moves: that the image is as old as the one before, and a frame
#: more; and that the delay changed to any other. Cameras work for hours, and hang for seconds.
HANGS: Final = 0.001
CHANGES: Final = 0.001
FRESH: Final = 0.95  # Probability that a camera of which nothing is known is on time.


class Look(NamedTuple):
    """An earlier image: its points above the ground (n, 3), ahead, left and up of the camera, and its pose."""

    points: Floats
    pose: NDArray[np.float64]
    at_s: float


class Moment:
    """Estimates, image after image, at which of the robot's recent poses a depth image was taken."""

    def __init__(self, mount: Mount) -> None:
        self._mount = mount
        self._track: deque[tuple[float, NDArray[np.float64]]] = deque()  # Times and poses, the newest first.
        self._belief = np.empty(0)  # Probability that an image was taken at each of these.
        self._looks: deque[Look] = deque()  # The newest last.
        self._last: NDArray[np.float32] | None = None
        self._first_pose = np.zeros(3)  # Pose at which the last image was first delivered.

    def of(self, depth_m: NDArray[np.float32], pose: Sequence[float], at_s: float) -> tuple[float, Sequence[float]]:
        """Return when and where an image was taken that is delivered as one of `at_s` and `pose`.

        Parameters
        ----------
        depth_m : array (height, width)
            Metres; 0, NaN or infinity where nothing was measured.
        pose : (3,)
            By the wheels: x and y in metres, heading in radians.
        at_s : float
            Stamp of the image, seconds; images come in this order.

        Returns
        -------
        (float, (3,))
            Seconds, at most `LONGEST_S` before `at_s`, and the pose by the wheels then.
        """
        here = np.asarray(pose, dtype=np.float64)
        self._step(here, at_s)
        if self._last is not None and np.array_equal(depth_m, self._last, equal_nan=True):
            if _apart(here, self._first_pose):  # The camera hangs: the image is as old as it was, and a frame more.
                self._belief = _later(self._belief)
        else:
            self._last, self._first_pose = depth_m.copy(), here
            points = _points(depth_m, self._mount)
            self._weigh(depth_m)
            self._looks.append(Look(points, self._track[self._best()][1], at_s))
            while self._looks[0].at_s < at_s - LONGEST_S:
                self._looks.popleft()
        return self._track[self._best()][0], tuple(self._track[self._best()][1])

    def _step(self, here: NDArray[np.float64], at_s: float) -> None:
        """Add a pose to the track; a delay of so many frames stays one of so many."""
        self._track.appendleft((at_s, here))
        self._belief = np.append(self._belief, 0.0 if self._belief.size else 1.0)
        while len(self._track) > 1 and self._track[-1][0] < at_s - LONGEST_S:
            self._track.pop()
            self._belief = np.append(self._belief[:-2], self._belief[-2:].sum())

    def _best(self) -> int:
        """Return the likeliest hypothesis; a delay of one frame is not told from none."""
        fresh = self._belief[:2].sum()
        return 0 if fresh >= self._belief.max() else int(self._belief.argmax())

    def _weigh(self, depth_m: NDArray[np.float32]) -> None:
        """Weigh the hypotheses by an image."""
        poses = np.array([one for _, one in self._track])
        if not self._looks or not any(_apart(one, poses[0]) for one in poses[1:]):
            return
        any_delay = np.full(len(poses), (1.0 - FRESH) / (len(poses) - 1))
        any_delay[0] = FRESH
        stays = 1.0 - HANGS - CHANGES
        self._belief = stays * self._belief + HANGS * _later(self._belief) + CHANGES * any_delay
        before = self._looks[0]
        costs = np.array([_cost(depth_m, before, one, self._mount) for one in poses])
        if np.isfinite(costs).all():
            self._belief *= np.exp(EVIDENCE * (costs.min() - costs))
            self._belief /= self._belief.sum()


def _later(belief: Floats) -> Floats:
    """Return the belief if every delay is a frame longer."""
    moved = np.append(0.0, belief[:-1])
    moved[-1] += belief[-1]
    return moved


def _apart(one: NDArray[np.float64], other: NDArray[np.float64]) -> bool:
    turned = abs(math.remainder(one[2] - other[2], math.tau))
    return math.hypot(one[0] - other[0], one[1] - other[1]) > STILL_M or turned > STILL_RAD


def _points(depth_m: NDArray[np.float32], mount: Mount) -> Floats:
    """Return points of an image that stand above the ground, (n, 3): ahead, left and up of the camera."""
    rows, columns = depth_m.shape
    every = max(1, math.ceil(math.sqrt(rows * columns / POINTS)))
    row, column = np.mgrid[every // 2 : rows : every, every // 2 : columns : every]
    ahead = depth_m[row, column].astype(np.float64)
    left = -(column + 0.5 - columns / 2.0) / (mount.focal * columns)
    up = -(row + 0.5 - rows / 2.0) / (mount.focal * columns)
    stands = np.isfinite(ahead) & (ahead > 0.0)
    stands[stands] = above_ground(mount.height_m + ahead[stands] * up[stands], ahead[stands])
    return np.stack([ahead[stands], ahead[stands] * left[stands], ahead[stands] * up[stands]], axis=1)


def _cost(depth_m: NDArray[np.float32], before: Look, pose: NDArray[np.float64], mount: Mount) -> float:
    """Return how far an image contradicts a pose, 0 to 1, by the points of one before; NaN where too few tell."""
    ahead, left, up = before.points.T
    offsets = np.stack([ahead + mount.ahead_m, left, np.zeros(ahead.size)], axis=1)
    there = seen_from(placed(offsets, before.pose), pose)
    ahead, left = there[:, 0] - mount.ahead_m, there[:, 1]
    rows, columns = depth_m.shape
    with np.errstate(divide="ignore", invalid="ignore"):
        row = np.rint(rows / 2.0 - 0.5 - mount.focal * columns * up / ahead)
        column = np.rint(columns / 2.0 - 0.5 - mount.focal * columns * left / ahead)
        inside = (ahead > 0.0) & (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
    measured = depth_m[row[inside].astype(np.intp), column[inside].astype(np.intp)].astype(np.float64)
    told = np.isfinite(measured) & (measured > 0.0)
    if told.sum() < FEW:
        return math.nan
    predicted = ahead[inside][told]
    error = np.abs(np.log(measured[told] / predicted)) / np.maximum(DIFFERS, DIFFERS_A_M * predicted)
    return float(np.minimum(error, 1.0).mean())

"""How alike views of one place are, and over which way they become unlike: what the map measures on its drives.

Views are compared from poses with about the same heading, since a view that is turned is another one. A car may never
have the same heading twice: of what it sees in a curve the turn is undone, by the view that it would have had turned
(`smal.virtual_views`), which is what the filter compares as well.
"""

import math
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
from numpy.typing import NDArray

from smal.demonstration import Image
from smal.movement import wrapped
from smal.settings import SETTINGS
from smal.virtual_views import Scene

#: Distances of pairs of frames, and the cosines of their views, (p,) each.
Compared = tuple[NDArray[np.float64], NDArray[np.float64]]
Frames = NDArray[np.float32]


def _apart(poses: NDArray[np.float64], car: bool) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return distances and angles between all poses of a drive, (f, f) each.

    Whole turns of a car count: what is reckoned of its way does not lead back to where a lap began.
    """
    across = poses[:, None, :2] - poses[None, :, :2]
    heading = np.unwrap(poses[:, 2]) if car else poses[:, 2]
    turned = heading[:, None] - heading[None, :]
    return np.hypot(across[..., 0], across[..., 1]), np.abs(turned if car else wrapped(turned))


def _spread(drives: NDArray[np.int32]) -> list[NDArray[np.intp]]:
    """Choose at most `SETTINGS.most_frames` frames of each drive, all over it."""
    each = [np.flatnonzero(drives == drive) for drive in np.unique(drives)]
    return [
        one[np.unique(np.linspace(0, one.size - 1, min(one.size, SETTINGS.most_frames)).astype(int))] for one in each
    ]


def turns_undone(
    images: Sequence[Image],
    centred: Frames,
    poses: NDArray[np.float64],
    drives: NDArray[np.int32],
    focal: float,
    describe: Callable[[Image], Frames],
) -> Compared:
    """Compare frames between which the robot turned, the first as it would have been seen with the second's heading.

    Parameters
    ----------
    images : sequence of uint8 arrays (height, width, 3)
    centred : float32 array (f, m)
        Centred features of every image, of unit length.
    poses : float64 array (f, 3)
        x, y and heading in radians.
    drives : int32 array (f,)
        Which drive each is of, ascending.
    focal : float
        Focal length over the image's width.
    describe : callable
        Centred features of an image.
    """
    found = []
    for frames in _spread(drives):
        distance, angle = _apart(poses[frames], car=True)
        curved = (angle >= math.radians(SETTINGS.same_deg)) & (angle < math.radians(SETTINGS.overlap_deg))
        one, other = np.nonzero(np.triu(curved & (distance < SETTINGS.reach * distance.max())))
        found.append(np.stack([frames[one], frames[other]], axis=1))
    pairs = np.concatenate(found)
    pairs = pairs[np.unique(np.linspace(0, len(pairs) - 1, min(len(pairs), SETTINGS.most_pairs)).astype(int))]
    first, second = pairs.T
    scene = Scene(focal, 1.0, 1e6)

    def cosine(one: int, other: int, turn_rad: float) -> float:
        return float(describe(scene.warp(images[one], turn_rad=turn_rad)) @ centred[other])

    with ThreadPoolExecutor() as pool:
        turns = wrapped(poses[second, 2] - poses[first, 2])
        cosines = list(pool.map(cosine, first.tolist(), second.tolist(), turns.tolist()))
    return np.hypot(*(poses[second, :2] - poses[first, :2]).T), np.array(cosines)


def correlation_length(
    centred: Frames, poses: NDArray[np.float64], drives: NDArray[np.int32], undone: Compared | None = None
) -> tuple[float, float]:
    """Measure the way ahead over which views become half as alike as they can be, and the cosine of unrelated ones.

    Parameters
    ----------
    centred, poses, drives
        See `turns_undone`.
    undone : (distances, cosines), optional
        What it gives.

    Raises
    ------
    ValueError
        No drive goes anywhere.
    """
    found: list[tuple[NDArray[Any], NDArray[Any]]] = [] if undone is None else [undone]
    unrelated = []
    for frames in _spread(drives):
        cosines = centred[frames] @ centred[frames].T
        distance, angle = _apart(poses[frames], undone is not None)
        reach = float(distance.max())
        unrelated.append(cosines[distance >= 0.1 * reach] if reach > 0.0 else np.zeros(1))
        same = (angle < math.radians(SETTINGS.same_deg)) & (distance < SETTINGS.reach * reach)
        found.append((distance[same], cosines[same]))
    background = float(np.concatenate(unrelated).mean())
    distances, cosines = (np.concatenate([one[k] for one in found]) for k in (0, 1))
    reach = float(distances.max(initial=0.0))
    if reach <= 0.0:
        raise ValueError("the robot does not move in any demonstration")
    edges = np.linspace(0.0, reach, 100)
    where = np.digitize(distances, edges[1:-1])
    count = np.bincount(where, minlength=99)
    mean = np.bincount(where, cosines, minlength=99)[count > 0] / count[count > 0]
    middle = ((edges[:-1] + edges[1:]) / 2.0)[count > 0]
    half = (1.0 + background) / 2.0
    return float(np.interp(-half, -np.minimum.accumulate(mean), middle)), background


def cosine_statistics(
    centred: Frames,
    poses: NDArray[np.float64],
    drives: NDArray[np.int32],
    place: tuple[float, float],
    undone: Compared | None = None,
) -> tuple[float, float, float]:
    """Measure how the cosines of views of one place, and of unrelated places, are distributed.

    Two views show one place if they were taken between `least` and `most` apart and are turned by less than 5 degrees;
    they are unrelated if they were taken more than 4 times `most` apart.

    Parameters
    ----------
    centred, poses, drives, undone
        See `correlation_length`.
    place : (least, most)
        From where views are new, to the correlation length.

    Returns
    -------
    (float, float, float)
        `kappa`, `outlier_cosine` and `alike_cosine` of `smal.visual_map.VisualMap`.

    Raises
    ------
    ValueError
        No two views show one place.
    """
    least, most = place
    near: list[NDArray[Any]] = []
    far: list[NDArray[Any]] = []
    if undone is not None:
        near.append(undone[1][(undone[0] > least) & (undone[0] < most)])
    for frames in _spread(drives):
        cosines = centred[frames] @ centred[frames].T
        distance, angle = _apart(poses[frames], undone is not None)
        near.append(cosines[(distance > least) & (distance < most) & (angle < math.radians(5.0))])
        far.append(cosines[distance > 4.0 * most])
    one, other = np.concatenate(near), np.concatenate(far)
    if not one.size:
        raise ValueError(
            "the demonstrations are too short, or their frames too far apart, to tell how alike views of one place are"
        )
    other = other if other.size else np.zeros(1)
    mean, deviation = float(one.mean()), max(float(one.std()), 1e-2)
    return 1.0 / deviation, (mean + float(other.mean())) / 2.0, mean - deviation

"""Where a traverse stands still: frames that repeat the one before, as at a light or in a station.

Template sequences advance at half to twice the speed of the queries, so that the frames of a stop fit none of them.
They are one place, seen many times, and count once in a window.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from smal.compiled import compiled

#: A frame is compared with so many before it.
REACH: Final = 16
#: Frames that repeat another at least; fewer are a slow traverse, which sequences of half the speed fit.
LEAST_FRAMES: Final = 4
# A step is one of standing still if it is shorter than this share of a step in moving: the upper quartile of all steps,
# since a traverse may stand for more than half of its frames.
_STANDING, _MOVING = 0.4, 0.75
_ROWS: Final = 128


def recent_products(features: NDArray[np.float32]) -> NDArray[np.float32]:
    """Multiply every frame with those before it.

    Parameters
    ----------
    features : float32 array (q, m)
        In order.

    Returns
    -------
    float32 array (q, REACH)
        Entry (t, b) is y_t . y_{t-1-b}; 0 where there is no such frame.
    """
    count = features.shape[0]
    found = np.zeros((count, REACH), dtype=np.float32)
    for start in range(0, count, _ROWS):
        before = max(0, start - REACH)
        end = min(count, start + _ROWS)
        products = features[start:end] @ features[before:end].T
        for back in range(1, REACH + 1):
            rows = np.arange(max(start, back), end)
            found[rows, back - 1] = products[rows - start, rows - back - before]
    return found


def recent_of_gram(gram: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the same of frames whose inner products (n, n) are all known."""
    found = np.zeros((gram.shape[0], REACH), dtype=np.float32)
    for back in range(1, min(REACH, gram.shape[0] - 1) + 1):
        found[back:, back - 1] = gram.diagonal(-back)
    return found


def first_frames(recent: NDArray[np.float32], norms: NDArray[np.float64]) -> NDArray[np.int64]:
    """Find the stops of a traverse.

    Parameters
    ----------
    recent : float32 array (n, REACH)
        See `recent_products`.
    norms : float64 array (n,)
        ||x_t||.

    Returns
    -------
    int64 array (n,)
        The first frame of the stop that each frame belongs to; of a frame in moving itself.
    """
    first = np.arange(norms.size)
    if norms.size >= LEAST_FRAMES:
        squares = np.square(norms)
        steps = squares[1:] + squares[:-1] - 2.0 * recent[1:, 0]
        _find(recent, squares, _STANDING**2 * float(np.quantile(steps, _MOVING)), first)
    return first


@compiled
def _find(recent: NDArray[np.float32], squares: NDArray[np.float64], limit: float, first: NDArray[np.int64]) -> None:
    start = 0
    while start < squares.size:
        anchor, end = start, start + 1
        while end < squares.size:
            distance = squares[end] + squares[anchor] - 2.0 * recent[end, end - anchor - 1]
            if distance >= limit:
                break
            end += 1
            if end - anchor > REACH:
                anchor = end - 1
        if end - start >= LEAST_FRAMES:
            first[start:end] = start
            start = end
        else:
            start += 1


def windows(first: NDArray[np.int64], length: int) -> NDArray[np.int64]:
    """Return the frames of the window that ends with each frame, from the first possible one on.

    Parameters
    ----------
    first : int64 array (q,)
        See `first_frames`.
    length : int
        l, at least 1.

    Returns
    -------
    int64 array (max(q - l + 1, 0), l)
        Ascending: the last l frames with every stop counted once, and the frame itself; plainly the last l where the
        traverse has not come so far yet.
    """
    ends = np.arange(length - 1, first.size)
    back = np.arange(length - 1, -1, -1)
    kept = np.unique(first)
    place = np.searchsorted(kept, first[ends])
    found: NDArray[np.int64] = kept[np.maximum(place[:, np.newaxis] - back, 0)]
    found[:, -1] = ends
    early = place < length - 1
    found[early] = ends[early, np.newaxis] - back
    return found

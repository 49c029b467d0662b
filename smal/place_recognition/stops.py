"""Where a traverse stands still: frames that repeat the one before, as at a light or in a station.

Template sequences advance at half to twice the speed of the queries, so that the frames of a stop fit none of them.
They are one place, seen many times, and count once in a window.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

#: A frame is compared with one at most so many before it: in a long stop the light changes.
REACH: Final = 16
#: Frames that repeat another at least; fewer are a slow traverse, which sequences of half the speed fit.
LEAST_FRAMES: Final = 4
# A step is one of standing still if it is shorter than this share of a step in moving: the upper quartile of all steps,
# since a traverse may stand for more than half of its frames.
_STANDING, _MOVING = 0.4, 0.75


def first_frames(features: NDArray[np.float32]) -> NDArray[np.int64]:
    """Find the stops of a traverse (n, m): the first frame of the stop that each frame belongs to, or itself (n,)."""
    first = np.arange(len(features))
    if first.size < LEAST_FRAMES:
        return first

    def apart(one: int, other: int) -> float:
        return float(np.linalg.norm(features[one] - features[other]))

    limit = _STANDING * float(np.quantile([apart(end, end - 1) for end in range(1, first.size)], _MOVING))
    start = 0
    while start < first.size:
        anchor, end = start, start + 1
        while end < first.size and apart(end, anchor) < limit:
            end += 1
            if end - anchor > REACH:
                anchor = end - 1
        if end - start < LEAST_FRAMES:
            end = start + 1
        first[start:end] = start
        start = end
    return first


def windows(first: NDArray[np.int64], length: int) -> NDArray[np.int64]:
    """Return the frames of the window that ends with each frame, from the first possible one on, (q - l + 1, l).

    Ascending: the last l frames with every stop (`first_frames`, (q,)) counted once, and the frame itself; plainly the
    last l where the traverse has not come so far yet.
    """
    ends, back = np.arange(length - 1, first.size), np.arange(length - 1, -1, -1)
    kept = np.unique(first)
    place = np.searchsorted(kept, first[ends])
    found: NDArray[np.int64] = kept[np.maximum(place[:, None] - back, 0)]
    found[:, -1] = ends
    early = place < length - 1
    found[early] = ends[early, None] - back
    return found

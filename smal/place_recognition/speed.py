"""How fast the queries pass the references, told from a first round of matches.

Nothing is known beforehand of the speeds of two traverses, and a penalty that prefers equal speeds is wrong where one
of them was driven faster. But where both rounds of matching are sure, the matched references say how fast they pass.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from smal.place_recognition.matches import Matches

#: Slower or faster than this is a wrong match rather than a speed.
_SLOWEST, _FASTEST = 0.4, 2.5
#: A match with less than this share of the median score is left out.
_SURE: Final = 0.7
#: As many median speeds of 1 are mixed in, which only counts where hardly any match is sure.
_DOUBT: Final = 5


def local_speeds(matches: Matches, length: int) -> NDArray[np.float64]:
    """Estimate the speed at every query: the median of the slopes between sure matches around it.

    Parameters
    ----------
    matches : Matches
        Of q queries.
    length : int
        Frames l of a window. A slope is taken over l frames, so that its two windows share none, and the median over
        the slopes that end within 2 l frames of the query.

    Returns
    -------
    float64 array (q,)
        Reference frames to one query frame, 0.5 to 2; that of the whole traverse where nothing near is sure, and 1
        where nothing is.
    """
    octaves = _slopes(matches, length)
    known = np.isfinite(octaves)
    everywhere = float(np.median(octaves[known])) if known.any() else 0.0
    found = np.full(octaves.size, everywhere)
    for query in range(octaves.size):
        near = octaves[max(0, query - 2 * length) : query + 2 * length + 1]
        near = near[np.isfinite(near)]
        if near.size >= _DOUBT:
            found[query] = float(np.median(near)) * near.size / (near.size + _DOUBT)
    speeds: NDArray[np.float64] = 2.0 ** np.clip(found, -1.0, 1.0)
    return speeds


def _slopes(matches: Matches, lag: int) -> NDArray[np.float64]:
    """Return log2 of the speed over the `lag` frames before each query, NaN where it is not sure."""
    slopes = np.full(matches.reference.size, np.nan)
    if not matches.matched.any() or matches.reference.size <= lag:
        return slopes
    sure = matches.matched & (matches.score >= _SURE * np.median(matches.score[matches.matched]))
    advance = (matches.reference[lag:] - matches.reference[:-lag]) / lag
    good = sure[lag:] & sure[:-lag] & (advance >= _SLOWEST) & (advance <= _FASTEST)
    slopes[lag:][good] = np.log2(advance[good])
    return slopes

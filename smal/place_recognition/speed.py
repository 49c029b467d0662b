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
#: As many slopes of the speed that would be assumed otherwise are mixed in: that of the whole traverse near a query,
#: equal speeds for the whole traverse. It only counts where hardly any match is sure.
_DOUBT: Final = 5


def local_speeds(matches: Matches, length: int) -> NDArray[np.float64]:
    """Estimate the speed at every query, (q,): the median of the slopes between sure matches around it.

    A slope is taken over the l frames of a window, so that its two windows share none, and the median over the slopes
    that end within 2 l frames of the query. The speed is in reference frames to one query frame, 0.5 to 2; the fewer
    slopes there are near a query the more that of the whole traverse, and the fewer there are at all the nearer to 1.
    """
    octaves = _slopes(matches, length)
    everywhere = _median(octaves, 0.0)
    found = np.empty(octaves.size)
    for query in range(octaves.size):
        found[query] = _median(octaves[max(0, query - 2 * length) : query + 2 * length + 1], everywhere)
    speeds: NDArray[np.float64] = 2.0 ** np.clip(found, -1.0, 1.0)
    return speeds


def _median(octaves: NDArray[np.float64], otherwise: float) -> float:
    """Return the median of what is known, drawn towards what is assumed otherwise where that is little.

    Wrong matches are spread over frames, so that in octaves more of them look fast than slow; weights make up for it.
    """
    known = np.sort(octaves[np.isfinite(octaves)])
    if not known.size:
        return otherwise
    below = np.cumsum(2.0**-known)
    median = float(known[np.searchsorted(below, below[-1] / 2)])
    return (median * known.size + otherwise * _DOUBT) / (known.size + _DOUBT)


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

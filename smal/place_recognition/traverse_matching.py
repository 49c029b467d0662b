"""The method on two traverses: every window of queries is matched in order, and the weights are read as places.

The window of a query is the last l frames up to it, where the frames of a stop count as one. Speeds are tried from
half to twice; a penalty keeps them near the speed at which the matches around advance, which a first round tells.
"""

from collections.abc import Callable
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from smal.place_recognition.matches import Matches, Progress, check_features, ignore
from smal.place_recognition.ordered_matching import SPEEDS, OrderedSolution, solve_ordered
from smal.place_recognition.speed import local_speeds
from smal.place_recognition.stops import first_frames, windows

#: lambda as a share of the smallest one for which W = 0.
RELATIVE_PENALTY: Final = 0.5
#: What a sequence is penalized for each octave between its speed and the expected one; half of it in the first round,
#: which can expect nothing but equal speeds. A frame that agrees entirely has a price of 1.
_SPEED_PENALTY: Final = 0.04
#: Sequences whose last frames lie this near to each other show one place.
_REACH: Final = 3


class _Places(NamedTuple):
    """References, each stop counted once: first and middle frames (k,), and inner products (k, k)."""

    frames: NDArray[np.int64]
    middle: NDArray[np.int64]
    gram: NDArray[np.float32]


def match_traverses(
    references: NDArray[np.float32],
    queries: NDArray[np.float32],
    length: int,
    relative_penalty: float = RELATIVE_PENALTY,
    progress: Progress = ignore,
) -> Matches:
    """Match every query with a reference.

    Parameters
    ----------
    references : float32 array (n, m)
        In order, centred and weighted (`smal.place_recognition.traverse_centering`).
    queries : float32 array (q, m)
    length : int
        l, at least 1.
    relative_penalty : float
        lambda as a share of the smallest one for which W = 0, above 0 and below 1.
    progress : callable
        Called with the number of queries that are done; those of the first round count half.

    Returns
    -------
    Matches
        None for the first l-1 queries, for windows that resemble nothing, and for any where n < l. The reference is
        the mean end of the sequences at the place with the most weight, and the score that weight times its share
        of all weights.

    Raises
    ------
    ValueError
        The features do not fit each other or are not finite, or a number is out of its range.

    Notes
    -----
    Takes 4 n (n + q) bytes beside the features.
    """
    check_features(references, queries, length)
    if not 0.0 < relative_penalty < 1.0:
        raise ValueError(f"the relative penalty must be above 0 and below 1, got {relative_penalty}")
    total = len(queries)
    if length > len(references):
        progress(total)
        return Matches.none(total)
    products, gram = queries @ references.T, references @ references.T
    norms = np.linalg.norm(queries, axis=1).astype(np.float64)
    standing, asked = first_frames(references), first_frames(queries)
    if length == 1 or np.unique(standing).size < length:
        standing = np.arange(len(references))
    places, frames = _places(gram, standing), windows(asked, length)

    def matched(speeds: NDArray[np.float64], speed_penalty: float, done: Callable[[int], None]) -> Matches:
        """Match all windows, at about the expected speeds (q,)."""
        matches, tried = Matches.none(total), (1.0,) if length == 1 else SPEEDS
        for query, window in enumerate(frames, length - 1):
            surcharge = speed_penalty * np.abs(np.log2(tried) - np.log2(speeds[query]))
            asked_for = products[window[:, None], places.frames]
            solution = solve_ordered(asked_for, norms[window], places.gram, tried, surcharge, relative_penalty)
            if solution.weights.size:
                place, matches.score[query] = place_of(solution, places.frames.size)
                matches.reference[query] = places.middle[place]
            done(query + 1)
        done(total)
        return matches

    equal = np.ones(total)
    if length == 1 or not len(frames):
        return matched(equal, 0.0, progress)
    first = matched(equal, _SPEED_PENALTY / 2, lambda done: progress(done // 2))
    moving, own = np.unique(asked, return_inverse=True)
    speeds = local_speeds(first.of(moving), length)[own]
    return matched(speeds, _SPEED_PENALTY, lambda done: progress((total + done) // 2))


def _places(gram: NDArray[np.float32], first: NDArray[np.int64]) -> _Places:
    frames = np.unique(first)
    last = np.searchsorted(first, frames, side="right") - 1
    return _Places(frames, (frames + last) // 2, gram if frames.size == first.size else gram[np.ix_(frames, frames)])


def place_of(solution: OrderedSolution, references: int) -> tuple[int, float]:
    """Return the place with the most weight, and how sure it is, of a solution with at least one sequence.

    The place is the weighted mean of the last frames of all sequences that end within 3 frames of the one around which
    most weight lies; the score is that weight, at least 0, times its share of all weights.
    """
    ends = solution.sequences % references
    near = np.abs(ends[:, None] - ends) <= _REACH
    weights = near @ solution.weights
    best = int(np.argmax(weights))
    there = solution.weights * near[best]
    return round(float(there @ ends / there.sum())), float(weights[best] ** 2 / solution.weights.sum())

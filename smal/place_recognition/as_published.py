"""The paper's matching as it stands, on two traverses: Eq. 7 with sequences cut at fixed phases, and Eq. 9.

Beside the method of `traverse_matching`, to show what order, speeds and centering add.
"""

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from smal.paper.matching.streaming import StreamingMatcher
from smal.paper.phase import matched_phase
from smal.place_recognition.matches import Matches, Progress, check_features, ignore

#: a in lambda1 = lambda2 = a sqrt(l), as in learning.
LAMBDA_SCALE: Final = 0.1


def match_as_in_the_paper(
    references: NDArray[np.float32],
    queries: NDArray[np.float32],
    length: int,
    lambda_scale: float,
    progress: Progress = ignore,
) -> Matches:
    """Match the l frames that end with each query by Eq. 7, with lambda1 = lambda2 = a sqrt(l).

    Parameters
    ----------
    references, queries : float32 arrays (n, m), (q, m)
        Centred by the mean of the references and weighted. References beyond the last whole sequence are left out.
    length : int
        l, at least 1.
    lambda_scale : float
        a, above 0.
    progress : callable
        Called with the number of queries that are done.

    Returns
    -------
    Matches
        None for the first l-1 queries, where W = 0, and for any where n < l. The reference is the frame of the
        best sequence (Eq. 9) at which W places the query (`matched_phase`), and the score its weight per frame.

    Raises
    ------
    ValueError
        The features do not fit each other or are not finite, or l is below 1.
    """
    check_features(references, queries)
    if length < 1:
        raise ValueError(f"a sequence needs a length of at least 1, got {length}")
    matches = Matches.none(queries.shape[0])
    whole = references.shape[0] // length * length
    if whole == 0:
        progress(queries.shape[0])
        return matches
    scale = lambda_scale * math.sqrt(length)
    matcher = StreamingMatcher(references[:whole].T, length, scale, scale, tolerance=1e-3)
    for query, frame in enumerate(queries):
        matcher.observe(frame)
        if matcher.ready:
            solution = matcher.match()
            best = solution.best_block
            if best is not None:
                place = best * length + matched_phase(solution, best)
                matches.reference[query] = int(np.clip(round(place), 0, references.shape[0] - 1))
                matches.score[query] = solution.block_weights.max() / length
        progress(query + 1)
    return matches

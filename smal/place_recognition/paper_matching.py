"""The paper's matching on two traverses: Eq. 7 at fixed phases, and Eq. 9; with l = 1 it is the paper's baseline."""

from smal.arrays import Float32s
from smal.paper.phase import matched_phase
from smal.paper.state_matching import solve, usual_lambda
from smal.place_recognition.matches import Matches, Progress, check_features, ignore


def match_as_in_the_paper(
    references: Float32s,
    queries: Float32s,
    length: int,
    progress: Progress = ignore,
) -> Matches:
    """Match the l frames that end with each query by Eq. 7, with `usual_lambda`.

    References (n, m) and queries (q, m) are centred by the mean of the references, of which whole sequences are used.
    There is no match for the first l-1 queries, if W = 0, or if n < l. The reference is the frame of the best sequence
    (Eq. 9) at the phase of the query in W, the score is its weight per frame. ValueError as in `check_features`.
    """
    check_features(references, queries)
    total = len(queries)
    whole = len(references) // length * length
    matches = Matches.none(total)
    templates = references[:whole].T
    penalty = usual_lambda(length)
    for query in range(length - 1, total if whole else 0):
        window = queries[query - length + 1 : query + 1].T
        solution = solve(templates, window, length, penalty, penalty, tolerance=1e-3)
        if (best := solution.best_block) is not None:
            place = round(best * length + matched_phase(solution, best))
            matches.reference[query] = min(max(place, 0), len(references) - 1)
            matches.score[query] = solution.block_weights.max() / length
        progress(query + 1)
    progress(total)
    return matches

"""The method on two traverses: every window of queries is matched in order, and the weights are read as places.

The window of a query is the last l frames up to it, where the frames of a stop count as one. Speeds are tried from
half to twice; a penalty keeps them near the speed at which the matches around advance, which a first round tells.
"""

from dataclasses import dataclass
from typing import Final, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from smal.place_recognition.matches import Matches, Progress, check_features, ignore
from smal.place_recognition.ordered_matching import OrderedSolution, solve_ordered
from smal.place_recognition.speed import local_speeds
from smal.place_recognition.stops import first_frames, windows
from smal.place_recognition.template_sequences import SPEEDS, TemplateSequences

#: Sequences whose last frames lie this near to each other show one place.
_REACH: Final = 3


@dataclass(frozen=True)
class OrderedSettings:
    """How to match.

    Parameters
    ----------
    length : int
        l, at least 1.
    relative_penalty : float
        lambda as a share of the smallest one for which W = 0, above 0 and below 1.
    speed_penalty : float
        What a sequence is penalized for each octave between its speed and the expected one, at least 0; half of it in
        the first round, which can expect nothing but equal speeds. A frame that agrees entirely has a price of 1.
    tolerance : float
        Relative duality gap.

    Raises
    ------
    ValueError
        A number is out of its range.
    """

    length: int = 10
    relative_penalty: float = 0.5
    speed_penalty: float = 0.04
    tolerance: float = 1e-3

    def __post_init__(self) -> None:
        if self.length < 1:
            raise ValueError(f"a window needs a length of at least 1, got {self.length}")
        if not 0.0 < self.relative_penalty < 1.0:
            raise ValueError(f"the relative penalty must be above 0 and below 1, got {self.relative_penalty}")
        if not 0.0 <= self.speed_penalty < np.inf:
            raise ValueError(f"the speed penalty must be finite and not negative, got {self.speed_penalty}")
        if not 0.0 < self.tolerance < 1.0:
            raise ValueError(f"the tolerance must be above 0 and below 1, got {self.tolerance}")


def match_traverses(
    references: NDArray[np.float32],
    queries: NDArray[np.float32],
    settings: OrderedSettings,
    progress: Progress = ignore,
) -> Matches:
    """Match every query with a reference.

    Parameters
    ----------
    references : float32 array (n, m)
        In order, centred and weighted (`smal.place_recognition.traverse_centering`).
    queries : float32 array (q, m)
    settings : OrderedSettings
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
        The features do not fit each other or are not finite.

    Notes
    -----
    Takes 4 n (n + q) bytes beside the features.
    """
    check_features(references, queries)
    total, count = queries.shape[0], references.shape[0]
    if settings.length > count:
        progress(total)
        return Matches.none(total)
    seen = _Seen(queries @ references.T, np.linalg.norm(queries, axis=1).astype(np.float64))
    gram = references @ references.T
    if settings.length == 1:
        every = _Places.of(gram, np.arange(count))
        return _match(seen, every, np.arange(total)[:, np.newaxis], np.ones(total), settings, 0.0, progress)
    places = _Places.of(gram, first_frames(references))
    if places.frames.size < settings.length:
        places = _Places.of(gram, np.arange(count))
    asked = first_frames(queries)
    moving, own = np.unique(asked, return_inverse=True)
    frames, penalty = windows(asked, settings.length), settings.speed_penalty
    first = _match(seen, places, frames, np.ones(total), settings, penalty / 2, lambda done: progress(done // 2))
    speeds = local_speeds(first.of(moving), settings.length)[own]
    return _match(seen, places, frames, speeds, settings, penalty, lambda done: progress((total + done) // 2))


class _Seen(NamedTuple):
    """Queries: their products with every reference (q, n), and their lengths (q,)."""

    products: NDArray[np.float32]
    norms: NDArray[np.float64]


class _Places(NamedTuple):
    """References, each stop counted once: first and middle frames (k,), and inner products (k, k)."""

    frames: NDArray[np.int64]
    middle: NDArray[np.int64]
    gram: NDArray[np.float32]

    @classmethod
    def of(cls, gram: NDArray[np.float32], first: NDArray[np.int64]) -> Self:
        frames = np.unique(first)
        last = np.searchsorted(first, frames, side="right") - 1
        return cls(frames, (frames + last) // 2, gram if frames.size == first.size else gram[np.ix_(frames, frames)])


def _match(
    seen: _Seen,
    places: _Places,
    frames: NDArray[np.int64],
    speeds: NDArray[np.float64],
    settings: OrderedSettings,
    speed_penalty: float,
    progress: Progress,
) -> Matches:
    """Match all windows, at about the expected speeds (q,)."""
    matches = Matches.none(speeds.size)
    everywhere = places.frames.size == seen.products.shape[1]
    sequences = TemplateSequences(settings.length, (1.0,) if settings.length == 1 else SPEEDS)
    for query, window in enumerate(frames, settings.length - 1):
        products = seen.products[window]
        solution = solve_ordered(
            products if everywhere else products[:, places.frames],
            seen.norms[window],
            places.gram,
            sequences,
            speed_penalty * np.abs(sequences.octaves - np.log2(speeds[query])),
            settings.relative_penalty,
            settings.tolerance,
        )
        if solution.weights.size:
            place, matches.score[query] = place_of(solution, places.frames.size)
            matches.reference[query] = places.middle[place]
        progress(query + 1)
    progress(speeds.size)
    return matches


def place_of(solution: OrderedSolution, references: int) -> tuple[int, float]:
    """Return the place with the most weight, and how sure it is.

    Parameters
    ----------
    solution : OrderedSolution
        With at least one sequence.
    references : int
        n.

    Returns
    -------
    reference : int
        Weighted mean of the last frames of all sequences that end within 3 frames of the one around which most
        weight lies.
    score : float
        That weight, at least 0, times its share of all weights.
    """
    ends = solution.sequences % references
    near = np.abs(ends[:, np.newaxis] - ends) <= _REACH
    weights = near @ solution.weights
    best = int(np.argmax(weights))
    there = solution.weights * near[best]
    return round(float(there @ ends / there.sum())), float(weights[best] ** 2 / solution.weights.sum())


def compile_ahead() -> None:
    """Compile what matching needs, for who sets up a machine; from the second time on that takes under a second."""
    frames = np.eye(12, dtype=np.float32)
    match_traverses(frames, frames, OrderedSettings(length=2))

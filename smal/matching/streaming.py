"""Matching a stream of frames: most of the work is done before the last frame of a sequence arrives.

The correlations of a frame with all templates are estimated when it arrives (`frame_ring`). After the last frame of a
sequence there remain exact products of that frame with few templates, a small solve, and a combination of known inner
products to certify it (`streamed_products`). Where residuals vanish, so that X^T X in float32 cannot certify
anything, the match is made once more in float64.
"""

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from smal.matching.frame_ring import FrameRing
from smal.matching.inner_products import Columns
from smal.matching.screening import Penalty
from smal.matching.streamed_products import StreamedProducts, StreamedQuery
from smal.matching.template_index import TemplateIndex
from smal.objective import l21_norm, s1_norm
from smal.state_matching import Solution, check_parameters, match

Array = NDArray[np.float64]

# Tolerance from which on X^T X in float32 is good enough to certify a match, since its rounding takes up a small part
# of the gap; and lengths of templates whose products float32 can hold.
_COARSE, _SHORTEST, _LONGEST = 5e-4, 1e-12, 1e12


class StreamingMatcher:
    """Keeps the last l frames and matches them.

    Parameters
    ----------
    templates : float array (m, n) or TemplateIndex
        X.
    sequence_length : int
        l.
    lambda1, lambda2 : float
        Of Eq. 7.
    tolerance : float
        Relative duality gap of each match.
    max_gram_bytes : int
        Memory for X^T X, 4 n^2 bytes. Where it does not fit, or the tolerance is below 5e-4, a match multiplies the
        few templates that matter once more in float64, which takes about twice the time.

    Raises
    ------
    ValueError
        Parameters out of range, or templates that are not finite.
    """

    def __init__(
        self,
        templates: NDArray[Any] | TemplateIndex,
        sequence_length: int,
        lambda1: float,
        lambda2: float,
        tolerance: float = 1e-4,
        max_gram_bytes: int = 2**30,
    ) -> None:
        index = templates if isinstance(templates, TemplateIndex) else TemplateIndex(templates)
        check_parameters(index.shape[1], sequence_length, lambda1, lambda2, tolerance)
        self._penalty = Penalty(sequence_length, lambda1, lambda2, tolerance)
        lengths = index.lengths[index.lengths > 0.0]
        representable = lengths.min(initial=1.0) > _SHORTEST and lengths.max(initial=1.0) < _LONGEST
        self._gram = index.gram() if representable and 4 * index.shape[1] ** 2 <= max_gram_bytes else None
        self._certifying = tolerance >= _COARSE
        self._ring = FrameRing(index, sequence_length)
        self.reset()

    def reset(self) -> None:
        """Forget all frames."""
        self._ring.reset()
        self._previous: Solution | None = None

    @property
    def ready(self) -> bool:
        """Whether l frames have arrived."""
        return self._ring.held == self._penalty.sequence_length

    def observe(self, frame: NDArray[Any]) -> None:
        """Take a frame in, and correlate it with all templates.

        Parameters
        ----------
        frame : float array (m,)

        Raises
        ------
        ValueError
            Of another length, NaN or infinity; the frame is then not taken in.
        """
        self._ring.observe(frame)

    def window(self) -> Array:
        """Return the last l frames in order, float64 (l, m).

        Raises
        ------
        ValueError
            There are not so many.
        """
        return self._ring.frames[self._order()]

    def match(self) -> Solution:
        """Match the last l frames; the sequences of the last match enter the working set at once.

        Raises
        ------
        ValueError
            There are not so many.
        """
        places = self._order()
        seen = np.flatnonzero(self._ring.norms[places] > 0.0)
        self._previous = self._match(places, seen)
        return self._previous

    def _match(self, places: Columns, seen: Columns) -> Solution:
        q, penalty, warm = places.size, self._penalty, self._previous
        if self._gram is not None and self._certifying and seen.size:
            products = StreamedProducts(self._ring, places[seen], self._gram)
            solution = _evaluated(match(products, seen, q, penalty, warm), self._ring, places, penalty)
            if solution.converged:
                return solution
            warm = solution
        return match(StreamedQuery(self._ring, places[seen], self._gram), seen, q, penalty, warm)

    def _order(self) -> Columns:
        """Return where the last l frames are in the ring."""
        return self._ring.places(self._penalty.sequence_length)


def _evaluated(solution: Solution, ring: FrameRing, places: Columns, penalty: Penalty) -> Solution:
    """Return the solution with the objective that its weights really have, and the gap to the bound from below."""
    X, Y, W = ring.index.templates, ring.frames[places].T, solution.active_weights
    residuals = np.linalg.norm(Y - X[:, solution.active].astype(np.float64) @ W, axis=0)
    value = float(residuals.sum()) + penalty.lambda1 * l21_norm(W)
    value += penalty.lambda2 * s1_norm(W, penalty.sequence_length, solution.active)
    bound = solution.objective * (1.0 - solution.duality_gap)
    gap = 1.0 - bound / value
    return replace(
        solution, objective=value, duality_gap=gap, converged=gap <= penalty.tolerance, residual_norms=residuals
    )


def compile_ahead() -> None:
    """Compile what matching needs, so that no robot waits for it; from the second time on that takes under a second."""
    matcher = StreamingMatcher(np.eye(8, dtype=np.float32), 2, 0.1, 0.1)
    for frame in np.eye(8, dtype=np.float32)[2:4]:
        matcher.observe(frame)
    matcher.match()

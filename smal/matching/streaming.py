"""Matching a stream of frames: most of the work is done before the last frame of a sequence arrives.

The correlations of a frame with all templates are computed when it arrives. After the last frame of a sequence
there remain one product with that frame, a small solve, and a combination of known inner products to certify it.
"""

import math
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from smal.matching.inner_products import Columns, DualPoint, Gradients
from smal.matching.narrow_product import rounding
from smal.matching.screening import Penalty
from smal.matching.template_index import IndexAndQuery, TemplateIndex
from smal.state_matching import Solution, check_parameters, match

Array = NDArray[np.float64]


class _StreamedQuery(IndexAndQuery):
    """X^T X (or not, where it is too large) and an estimate of X^T Y are known beforehand."""

    def __init__(
        self,
        index: TemplateIndex,
        query: Array,
        gram: NDArray[np.float32] | None,
        correlations: NDArray[np.float32],
        radii: NDArray[np.float32],
    ) -> None:
        super().__init__(index, query)
        self._products, self._correlations, self._radii = gram, correlations, radii

    def guess(self) -> NDArray[np.float32]:
        """Return the known correlations."""
        return self._correlations

    def gradients(self, dual: DualPoint, columns: Columns | None, *, fine: bool = False) -> Gradients:
        """Combine rows of X^T X, or else multiply with the rounded templates."""
        if columns is not None or self._products is None:
            return super().gradients(dual, columns, fine=fine)
        values = self._correlations * dual.alpha.astype(np.float32)
        values -= self._products[dual.columns].T @ dual.B.astype(np.float32)
        lengths = self.lengths()
        # Each product is off by rounding(m), and their sum by rounding(p).
        m, p = self._templates.shape[0], dual.columns.size
        reach = float((lengths[dual.columns] * np.linalg.norm(dual.B, axis=1)).sum())
        reach += float(np.linalg.norm(dual.alpha * np.sqrt(self.squares)))
        radii = np.sqrt(np.square(self._radii) @ np.square(dual.alpha).astype(np.float32)).astype(np.float64)
        return Gradients(values, radii * (1.0 + 1e-5) + lengths * (reach * rounding(m + p + 4)))


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
        Memory for X^T X, 4 n^2 bytes. Where it does not fit, certifying a match takes a pass over the rounded
        templates instead.

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
        self._index = templates if isinstance(templates, TemplateIndex) else TemplateIndex(templates)
        m, n = self._index.shape
        check_parameters(n, sequence_length, lambda1, lambda2, tolerance)
        self._penalty = Penalty(sequence_length, lambda1, lambda2, tolerance)
        X = self._index.templates
        self._gram = X.T @ X if 4 * n * n <= max_gram_bytes else None
        # Rings: place t % l belongs to the frame that arrived as number t.
        self._frames = np.zeros((sequence_length, m))
        self._correlations = np.zeros((n, sequence_length), dtype=np.float32)
        self._radii = np.zeros((n, sequence_length), dtype=np.float32)
        self.reset()

    def reset(self) -> None:
        """Forget all frames."""
        self._count = 0
        self._previous: Solution | None = None

    @property
    def held(self) -> int:
        """How many of the last frames are here, at most l."""
        return min(self._count, self._penalty.sequence_length)

    @property
    def ready(self) -> bool:
        """Whether l frames have arrived."""
        return self.held == self._penalty.sequence_length

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
        if frame.shape != (self._frames.shape[1],):
            raise ValueError(f"a frame must have the shape ({self._frames.shape[1]},), got {frame.shape}")
        if not np.isfinite(np.square(frame, dtype=np.float64).sum()):
            raise ValueError("the frame contains NaN or infinity")
        place = self._count % self._penalty.sequence_length
        self._frames[place] = frame
        estimate = self._index.correlate(self._frames[place : place + 1])
        self._correlations[:, place] = estimate.values[:, 0]
        self._radii[:, place] = estimate.radii
        self._count += 1

    def window(self, frames: int | None = None) -> Array:
        """Return the last frames, l unless told otherwise, in order, float64 (frames, m).

        Raises
        ------
        ValueError
            There are not so many.
        """
        return self._frames[self._order(frames)]

    def correlations(self, columns: Columns) -> NDArray[np.float32]:
        """Estimate the inner products of template frames (..., q) with the last q frames, each with its own.

        Raises
        ------
        ValueError
            There are not so many frames.
        """
        return self._correlations[columns, self._order(columns.shape[-1])]

    def match(self, frames: int | None = None) -> Solution:
        """Match the last l frames, or fewer; the sequences of the last match enter the working set at once.

        Parameters
        ----------
        frames : int, optional
            q, 1 to l. The penalties of Eq. 7 grow with the square root of a query's length, as `lambda_scale` has it.

        Raises
        ------
        ValueError
            There are not so many frames yet, or never will be.
        """
        length = self._penalty.sequence_length
        q = length if frames is None else frames
        order = self._order(q)
        seen = np.flatnonzero(np.square(self._frames[order]).sum(axis=1) > 0.0)
        places = order[seen]
        products = _StreamedQuery(
            self._index, self._frames[places].T, self._gram, self._correlations[:, places], self._radii[:, places]
        )
        share = math.sqrt(q / length)
        penalty = replace(self._penalty, lambda1=share * self._penalty.lambda1, lambda2=share * self._penalty.lambda2)
        solution = match(products, seen, q, penalty, self._previous)
        if q == length:
            self._previous = solution
        return solution

    def _order(self, frames: int | None = None) -> Columns:
        """Return where the last frames are in the rings."""
        length = self._penalty.sequence_length
        wanted = length if frames is None else frames
        if not 1 <= wanted <= length:
            raise ValueError(f"the last 1 to {length} frames can be asked for, not {wanted}")
        if wanted > self._count:
            raise ValueError(f"this needs {wanted} frames, there are {self._count}")
        order: Columns = (self._count + np.arange(length - wanted, length)) % length
        return order


def compile_ahead() -> None:
    """Compile what matching needs, so that no robot waits for it; from the second time on that takes under a second."""
    matcher = StreamingMatcher(np.eye(8, dtype=np.float32), 2, 0.1, 0.1)
    for frame in np.eye(8, dtype=np.float32)[2:4]:
        matcher.observe(frame)
    matcher.match()

"""Safe screening: a dual point of Eq. 7 rules out template sequences that can have no weight.

Bounds on the polars (`certificate`) come from rounded products, with the error of these added, and follow the dual
point when it moves. So a bound never rules out a sequence that the solution needs, whatever the precision of
the products that it rests on; the few that stay in doubt are looked at with exact products.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from smal.matching.certificate import all_polar_bounds, polar_bound, row_balls
from smal.matching.inner_products import Columns, DualPoint, InnerProducts, common

Array = NDArray[np.float64]

# Alternating projections: from rounded products, and from exact ones.
_QUICK, _THOROUGH = 8, 100
# Sequences that are looked at with exact products at a time.
_MOST_EXACT = 64
# A row is worth a weight if the dual point holds it nearly as far as it can.
_TIGHT = 0.7
_TINY = 1e-150


@dataclass(frozen=True)
class Penalty:
    """What Eq. 7 charges, and how exactly it is to be minimised.

    Parameters
    ----------
    sequence_length : int
    lambda1, lambda2 : float
    tolerance : float
        Relative duality gap at which to stop.
    """

    sequence_length: int
    lambda1: float
    lambda2: float
    tolerance: float

    @property
    def slack(self) -> float:
        """How far a polar may exceed 1 without needing attention."""
        return 0.25 * self.tolerance


@dataclass(frozen=True, eq=False)
class Violations:
    """Sequences outside the dual set.

    Parameters
    ----------
    polars : float64 array (k,)
        Bounds on their polars, above 1.
    tight : tuple of k intp arrays
        Template frames of each that hold it there.
    """

    polars: Array
    tight: tuple[Columns, ...]

    def worst(self, most: int) -> Columns:
        """Template frames of the sequences that are farthest out, ascending."""
        order = np.argsort(-self.polars, kind="stable")[:most]
        chosen: Columns = np.unique(np.concatenate([np.zeros(0, dtype=np.intp), *(self.tight[i] for i in order)]))
        return chosen

    def joined(self, other: "Violations") -> "Violations":
        """Return these and those."""
        return Violations(np.concatenate([self.polars, other.polars]), self.tight + other.tight)


class Screening:
    """Upper bounds on the polars of all sequences at one dual point.

    Parameters
    ----------
    products : InnerProducts
    penalty : Penalty
    """

    def __init__(self, products: InnerProducts, penalty: Penalty) -> None:
        self._products, self._penalty = products, penalty
        self._polars = np.full(-(-products.size // penalty.sequence_length), np.inf)
        self._at: DualPoint | None = None

    @property
    def largest(self) -> float:
        """Bound on the largest polar, at least 1."""
        return max(1.0, float(self._polars.max(initial=0.0)))

    def frames(self, blocks: Columns) -> Columns:
        """Template frames of sequences."""
        length = self._penalty.sequence_length
        every = (blocks[:, None] * length + np.arange(length)).ravel()
        existing: Columns = every[every < self._products.size]
        return existing

    def probe(self, dual: DualPoint, blocks: Columns, threshold: float) -> Violations:
        """Look at some sequences with rounded products, to learn what a working set lacks; certifies nothing."""
        frames, penalty = self.frames(blocks), self._penalty
        length, exact = penalty.sequence_length, np.zeros(frames.size)
        values = self._products.gradients(dual, frames).values
        bounds = all_polar_bounds(values, exact, length, penalty.lambda1, penalty.lambda2, 0, threshold)
        suspects = bounds > threshold
        chosen = np.repeat(suspects, length)[: frames.size]
        gradients = values[chosen].astype(np.float64)
        return self._split(blocks[suspects], frames[chosen], gradients, dual, _QUICK, threshold)[1]

    def extend(self, dual: DualPoint) -> Violations:
        """Bound all polars; where the last dual point is near enough, without new products."""
        # The sequences that the dual point was made for lie on the edge of the dual set: only exact products tell.
        working = np.unique(dual.columns // self._penalty.sequence_length)
        enough = 1.0 + self._penalty.slack
        self._follow(dual)
        doubtful = np.flatnonzero(self._polars > enough)
        if 2 * doubtful.size > self._polars.size:
            self._polars = self._bound(dual, None)
        elif doubtful.size:
            self._polars[doubtful] = self._bound(dual, self.frames(doubtful))
        self._at = dual
        violations = self._sharpen(dual, working)
        others = self._in_doubt(working)
        if others.size > _MOST_EXACT:
            self._polars[others] = self._bound(dual, self.frames(others), fine=True)
            others = self._in_doubt(working)
        for start in range(0, others.size, _MOST_EXACT):
            violations = violations.joined(self._sharpen(dual, others[start : start + _MOST_EXACT]))
            if violations.polars.size:
                break
        return violations

    def _in_doubt(self, working: Columns) -> Columns:
        """Other sequences that are not ruled out, the most doubtful first."""
        doubtful = self._polars > 1.0 + self._penalty.slack
        doubtful[working] = False
        others = np.flatnonzero(doubtful)
        ordered: Columns = others[np.argsort(-self._polars[others], kind="stable")]
        return ordered

    def _sharpen(self, dual: DualPoint, blocks: Columns) -> Violations:
        """Bound polars from exact products."""
        blocks = np.sort(blocks)
        frames = self.frames(blocks)
        gradients = self._products.exact_gradients(dual, frames)
        enough = 1.0 + self._penalty.slack
        self._polars[blocks], violations = self._split(blocks, frames, gradients, dual, _THOROUGH, enough)
        return violations

    def _bound(self, dual: DualPoint, frames: Columns | None, *, fine: bool = False) -> Array:
        found, penalty = self._products.gradients(dual, frames, fine=fine), self._penalty
        length, lambda1, lambda2 = penalty.sequence_length, penalty.lambda1, penalty.lambda2
        return all_polar_bounds(found.values, found.radii, length, lambda1, lambda2, _QUICK, 1.0 + penalty.slack)

    def _follow(self, dual: DualPoint) -> None:
        """Move the bounds with the dual point: a polar is a norm, so it grows at most by that of the movement."""
        step = self._products.movement(self._at, dual) if self._at is not None else None
        if step is None:
            self._polars[:] = np.inf
            return
        length, missing = self._penalty.sequence_length, -self._products.size % self._penalty.sequence_length
        lengths = np.pad(self._products.lengths(), (0, missing)).reshape(-1, length)
        longest_rows = np.maximum(lengths.max(axis=1) * step[0], _TINY)
        longest_columns = np.maximum(np.sqrt(np.square(lengths).sum(axis=1)) * step[1], _TINY)
        self._polars += 1.0 / (self._penalty.lambda1 / longest_rows + self._penalty.lambda2 / longest_columns)

    def _split(
        self, blocks: Columns, frames: Columns, gradients: Array, dual: DualPoint, rounds: int,
        enough: float,
    ) -> tuple[Array, Violations]:  # fmt: skip
        """Bound polars one by one from X^T Theta of their frames, starting from U where it is known."""
        penalty, length = self._penalty, self._penalty.sequence_length
        guesses = row_balls(gradients / (penalty.lambda1 + penalty.lambda2))
        if penalty.lambda1 > 0.0:
            # Where the columns are at the edge of their balls, rows without weight have to do without them.
            solved = np.isin(frames // length, dual.columns // length)
            guesses[solved] = row_balls(gradients[solved] / penalty.lambda1)
        here, there = common(frames, dual.columns)
        guesses[here] = dual.U[there]
        edges = np.searchsorted(frames // length, np.append(blocks, self._polars.size))
        bounds, tight = np.empty(blocks.size), []
        for number, (start, end) in enumerate(pairwise(edges)):
            G, U, V = gradients[start:end], guesses[start:end], np.empty_like(guesses[start:end])
            bounds[number] = polar_bound(G, penalty.lambda1, penalty.lambda2, U, V, rounds, enough)
            if bounds[number] > enough:
                needed = np.linalg.norm(G - penalty.lambda2 * V, axis=1)
                tight.append(frames[start:end][needed >= _TIGHT * penalty.lambda1])
        return bounds, Violations(bounds[bounds > enough], tuple(tight))

"""Problems for ordered matching, and their optimum over all sequences, straight from the definition in float64."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from types import MappingProxyType

import cvxpy as cp
import numpy as np
from numpy.typing import NDArray

from smal.place_recognition.ordered_matching import OrderedSolution, solve_ordered

Array = NDArray[np.float64]


#: A residual shorter than this has no direction; any theta with a norm of at most 1 is a point of the dual.
FLOOR = 5e-4


@dataclass(frozen=True, eq=False)
class OrderedProblem:
    """References x (n, m), one query sequence y (l, m), and the parameters of `solve_ordered`."""

    references: Array
    queries: Array
    speeds: tuple[float, ...] = (1.0,)
    surcharge: tuple[float, ...] = (0.0,)
    relative_penalty: float = 0.5

    def solve(self, tolerance: float = 1e-6) -> OrderedSolution:
        return solve_ordered(
            (self.queries @ self.references.T).astype(np.float32),
            np.linalg.norm(self.queries, axis=1),
            (self.references @ self.references.T).astype(np.float32),
            self.speeds,
            np.array(self.surcharge),
            self.relative_penalty,
            tolerance,
        )

    @cached_property
    def sequences(self) -> dict[int, list[int]]:
        """Frames of every sequence by its number v n + e, as the docstring of `solve_ordered` defines them."""
        n, length = len(self.references), len(self.queries)
        found = {}
        for place, speed in enumerate(self.speeds):
            for end in range(n):
                frames = [end - math.floor(speed * (length - 1 - i) + 0.5) for i in range(length)]
                if frames[0] >= 0:
                    found[place * n + end] = frames
        return found

    @property
    def templates(self) -> Array:
        """x_{j,i} of all sequences, (p, l, m)."""
        return self.references[np.array(list(self.sequences.values()), dtype=int).reshape(-1, len(self.queries))]

    @property
    def surcharges(self) -> Array:
        """Of all sequences, (p,)."""
        return np.array([self.surcharge[number // len(self.references)] for number in self.sequences])

    def prices(self, theta: Array) -> Array:
        """1/l sum_i x_{j,i} . theta_i of all sequences, (p,)."""
        return np.einsum("pim,im->p", self.templates, theta) / len(self.queries)

    @cached_property
    def penalty(self) -> float:
        """lambda, from the smallest one for which c = 0 (0 where it is so for all)."""
        norms = np.linalg.norm(self.queries, axis=1, keepdims=True)
        directions = np.divide(self.queries, norms, out=np.zeros_like(self.queries), where=norms > 0)
        largest = float(np.max(self.prices(directions) - self.surcharges, initial=0.0))
        return self.relative_penalty * max(largest, 0.0)

    def weights(self, solution: OrderedSolution) -> Array:
        """Return c of all sequences, (p,); fails where a weight belongs to no sequence."""
        chosen = dict(zip(solution.sequences.tolist(), solution.weights.tolist(), strict=True))
        assert set(chosen) <= set(self.sequences)
        return np.array([chosen.get(number, 0.0) for number in self.sequences])

    def residuals(self, weights: Array) -> Array:
        """y_i - sum_j c_j x_{j,i}, (l, m)."""
        residuals: Array = self.queries - np.einsum("p,pim->im", weights, self.templates)
        return residuals

    def primal(self, weights: Array) -> float:
        return float(
            np.linalg.norm(self.residuals(weights), axis=1).mean() + (self.penalty + self.surcharges) @ weights
        )

    def dual(self, weights: Array) -> float:
        """Return a lower bound on the optimum, by the residuals' directions, scaled until they are feasible."""
        residuals = self.residuals(weights)
        theta = residuals / np.maximum(np.linalg.norm(residuals, axis=1, keepdims=True), FLOOR)
        share = np.max(self.prices(theta) / (self.penalty + self.surcharges), initial=1.0)
        return float(np.sum(theta * self.queries) / len(self.queries) / share)

    def gap(self, weights: Array) -> float:
        """Relative duality gap over all sequences."""
        return (self.primal(weights) - self.dual(weights)) / self.primal(weights)

    def optimum(self) -> float:
        """Of the program in `ordered_matching`'s docstring, by an interior-point solver."""
        templates = self.templates
        weights = cp.Variable(len(templates), nonneg=True)
        loss = sum(
            cp.norm(query - templates[:, i].T @ weights, 2) for i, query in enumerate(self.queries)
        ) / len(self.queries)  # fmt: skip
        program = cp.Problem(cp.Minimize(loss + (self.penalty + self.surcharges) @ weights))
        program.solve(solver=cp.CLARABEL, tol_gap_abs=1e-8, tol_gap_rel=1e-8, tol_feas=1e-8)
        return float(program.value)


def unit(vectors: Array) -> Array:
    lengths = np.linalg.norm(vectors, axis=-1, keepdims=True)
    scaled: Array = np.divide(vectors, lengths, out=np.zeros_like(vectors), where=lengths > 0)
    return scaled


def walk(rng: np.random.Generator, count: int, size: int, step: float = 0.6) -> Array:
    """Return a path on the sphere (count, size): neighbours resemble each other, others do not."""
    return unit(np.cumsum(rng.normal(size=(count, size)), axis=0) * step + rng.normal(size=(count, size)))


def _random(rng: np.random.Generator, n: int, length: int) -> tuple[Array, Array]:
    return unit(rng.normal(size=(n, 12))), unit(rng.normal(size=(length, 12)))


def _walk(rng: np.random.Generator, n: int, length: int) -> tuple[Array, Array]:
    """Copy a piece of the references with noise, or what there is of it."""
    references = walk(rng, n, 16)
    ends = np.arange(length) + rng.integers(0, max(1, n - length + 1))
    return references, unit(references[ends % n] + 0.15 * rng.normal(size=(length, 16)))


def _duplicates(rng: np.random.Generator, n: int, length: int) -> tuple[Array, Array]:
    """Let every reference come at least twice, one traverse after the other."""
    references, queries = _walk(rng, (n + 1) // 2, length)
    return np.concatenate([references, references]), queries


def _blind(rng: np.random.Generator, n: int, length: int) -> tuple[Array, Array]:
    """Let some query frames show nothing, perhaps all."""
    references, queries = _walk(rng, n, length)
    queries[rng.random(length) < 0.5] = 0.0
    return references, queries


def _identical(rng: np.random.Generator, n: int, length: int) -> tuple[Array, Array]:
    references = walk(rng, max(n, length), 16)
    return references, references[-length:].copy()


def _opposed(rng: np.random.Generator, n: int, length: int) -> tuple[Array, Array]:
    """Let no reference have a positive product with any query frame."""
    return unit(np.abs(rng.normal(size=(n, 8)))), -unit(np.abs(rng.normal(size=(length, 8))))


def _uneven(rng: np.random.Generator, n: int, length: int) -> tuple[Array, Array]:
    """Take frames of any length: nothing in the program asks for unit vectors."""
    references, queries = _walk(rng, n, length)
    return references * rng.uniform(0.1, 3.0, (n, 1)), queries * rng.uniform(0.1, 3.0, (length, 1))


STRUCTURES: Mapping[str, Callable[[np.random.Generator, int, int], tuple[Array, Array]]] = MappingProxyType(
    {
        "random": _random,
        "walk": _walk,
        "duplicates": _duplicates,
        "blind": _blind,
        "identical": _identical,
        "opposed": _opposed,
        "uneven": _uneven,
    }
)

#: With the surcharge of each speed.
SPEED_TABLES = (
    ((1.0,), (0.0,)),
    ((0.5, 1.0, 2.0), (0.0, 0.0, 0.0)),
    ((0.5, 0.75, 1.0, 1.5, 2.0), (0.04, 0.02, 0.0, 0.02, 0.04)),
)


def problem_of(structure: str, seed: int, n: int, length: int, speeds: int, relative_penalty: float) -> OrderedProblem:
    references, queries = STRUCTURES[structure](np.random.default_rng(seed), n, length)
    return OrderedProblem(references, queries, *SPEED_TABLES[speeds], relative_penalty)

"""Inner products of templates, each computed when and as far as a solver asks for them."""

from collections import OrderedDict
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Columns = NDArray[np.intp]


class TemplateProducts(Protocol):
    """Inner products of the n template frames X."""

    def gram(self, columns: Columns) -> Array:
        """X_S^T X_S, float64 (p, p), for the p chosen template frames S."""

    def correlate(self, columns: Columns, weights: Array) -> NDArray[np.float32]:
        """X^T X_S B, float32 (n, q), for weights B (p, q)."""


class DenseTemplates:
    """Computes every product from the templates: one pass over X for each `correlate`.

    Parameters
    ----------
    templates : float array (m, n)
        X; contiguous per template (column) is fastest.
    """

    def __init__(self, templates: NDArray[Any]) -> None:
        self._templates = templates

    def gram(self, columns: Columns) -> Array:
        """Compute the chosen products in float64: a residual near zero needs the digits."""
        chosen = self._templates[:, columns].astype(np.float64)
        return np.asarray(chosen.T @ chosen)

    def correlate(self, columns: Columns, weights: Array) -> NDArray[np.float32]:
        """Multiply twice, never forming X^T X."""
        combined = self._templates[:, columns] @ weights.astype(self._templates.dtype)
        return np.asarray(self._templates.T @ combined, dtype=np.float32)


class GramMatrix:
    """Looks every product up in X^T X.

    Parameters
    ----------
    gram : float array (n, n)
    """

    def __init__(self, gram: NDArray[Any]) -> None:
        if gram.ndim != 2 or gram.shape[0] != gram.shape[1]:
            raise ValueError(f"a Gram matrix must be square, got the shape {gram.shape}")
        self._gram = gram

    def gram(self, columns: Columns) -> Array:
        """Look the chosen products up."""
        return np.asarray(self._gram[np.ix_(columns, columns)], dtype=np.float64)

    def correlate(self, columns: Columns, weights: Array) -> NDArray[np.float32]:
        """Combine columns of X^T X; it is symmetric, and its rows are contiguous."""
        rows = np.asarray(self._gram[columns], dtype=np.float32)
        return np.asarray(rows.T @ weights.astype(np.float32))


class CachedTemplates:
    """Computes X^T X_j when sequence j is first asked for, and keeps the most recently used ones.

    A robot meets the same few sequences in query after query, so that most queries need no pass over X.

    Parameters
    ----------
    templates : float32 array (m, n)
    sequence_length : int
    max_bytes : int
        Memory for kept products, 4 n l bytes a sequence.
    """

    def __init__(self, templates: NDArray[np.float32], sequence_length: int, max_bytes: int = 256 * 2**20) -> None:
        self._templates = templates
        self._length = sequence_length
        n = templates.shape[1]
        self._capacity = max(1, max_bytes // max(1, 4 * n * sequence_length))
        self._kept: OrderedDict[int, NDArray[np.float32]] = OrderedDict()

    def _products(self, block: int) -> NDArray[np.float32]:
        """Rows X_j^T X, float32 (l, n)."""
        rows = self._kept.get(block)
        if rows is None:
            start = block * self._length
            rows = self._templates[:, start : start + self._length].T @ self._templates
            if len(self._kept) >= self._capacity:
                self._kept.popitem(last=False)
            self._kept[block] = rows
        self._kept.move_to_end(block)
        return rows

    def _rows(self, columns: Columns) -> NDArray[np.float32]:
        blocks, starts = np.unique(columns // self._length, return_index=True)
        ends = np.append(starts[1:], columns.size)
        parts = [
            self._products(int(block))[columns[start:end] % self._length]
            for block, start, end in zip(blocks, starts, ends, strict=True)
        ]
        return np.concatenate(parts)

    def gram(self, columns: Columns) -> Array:
        """Products of the chosen template frames, sorted ascending."""
        return np.asarray(self._rows(columns)[:, columns], dtype=np.float64)

    def correlate(self, columns: Columns, weights: Array) -> NDArray[np.float32]:
        """Combine the kept products."""
        return np.asarray(self._rows(columns).T @ weights.astype(np.float32))


def prepare_products(
    templates: NDArray[np.float32], sequence_length: int, max_bytes: int = 2**30
) -> GramMatrix | CachedTemplates:
    """Choose how to look up inner products of templates that many queries will be matched with.

    The whole Gram matrix where it fits: one product now, none later. Otherwise what queries ask for, cached.

    Parameters
    ----------
    templates : float32 array (m, n)
    sequence_length : int
    max_bytes : int
        Memory for products; the Gram matrix takes 4 n^2 bytes.
    """
    if 4 * templates.shape[1] ** 2 <= max_bytes:
        return GramMatrix(templates.T @ templates)
    return CachedTemplates(templates, sequence_length, max_bytes)

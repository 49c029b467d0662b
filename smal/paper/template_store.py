"""A growing matrix of template frames, and of their inner products."""

import numpy as np
from numpy.typing import NDArray

_FIRST_CAPACITY = 64


class MemoryBoundError(MemoryError):
    """The templates would need more memory than was allowed."""


class TemplateStore:
    """X, one template frame a column, appended to without copying X each time (the capacity doubles).

    Parameters
    ----------
    size : int
        m, entries of a feature vector.
    max_bytes : int, optional
        Bound on the memory of both.

    Raises
    ------
    MemoryBoundError
        From `append`, naming the setting.
    """

    def __init__(self, size: int, max_bytes: int | None = None) -> None:
        self._max_bytes = max_bytes
        self._count = 0
        # Row-contiguous per template; `templates` shows the transpose.
        self._rows = np.empty((0, size), dtype=np.float32)
        self._gram = np.empty((0, 0), dtype=np.float32)

    def __len__(self) -> int:
        return self._count

    @property
    def templates(self) -> NDArray[np.float32]:
        """X, float32 (m, n): a view, contiguous per column."""
        return self._rows[: self._count].T

    @property
    def gram(self) -> NDArray[np.float32]:
        """X^T X, float32 (n, n): a view.

        It costs no time, since appending a sequence needs its correlations with X anyway, and 4 n bytes a template
        frame next to the 4 m bytes of the frame itself.
        """
        return self._gram[: self._count, : self._count]

    @staticmethod
    def bytes_for(size: int, count: int) -> int:
        """Memory of so many template frames of m = size entries, with their inner products."""
        return 4 * count * (size + count)

    def append(self, frames: NDArray[np.float32], correlations: NDArray[np.float32]) -> None:
        """Add template frames.

        Parameters
        ----------
        frames : float32 array (q, m)
        correlations : float32 array (n, q)
            Of the templates there were before with the new ones.
        """
        old, new = self._count, self._count + frames.shape[0]
        self._reserve(new)
        self._rows[old:new] = frames
        self._gram[old:new, :old] = correlations.T
        self._gram[:old, old:new] = correlations
        self._gram[old:new, old:new] = frames @ frames.T
        self._count = new

    def _reserve(self, count: int) -> None:
        capacity = self._rows.shape[0]
        if count <= capacity:
            return
        grown = max(count, 2 * capacity, _FIRST_CAPACITY)
        if self._max_bytes is not None and self.bytes_for(self._rows.shape[1], grown) > self._max_bytes:
            grown = count
            if self.bytes_for(self._rows.shape[1], count) > self._max_bytes:
                needed, allowed = self.bytes_for(self._rows.shape[1], count) / 2**20, self._max_bytes / 2**20
                raise MemoryBoundError(
                    f"{count} template frames need {needed:.1f} MiB, more than the {allowed:.1f} MiB allowed; "
                    "allow more, or merge more by a laxer novelty test"
                )
        rows = np.empty((grown, self._rows.shape[1]), dtype=np.float32)
        rows[: self._count] = self._rows[: self._count]
        self._rows = rows
        gram = np.empty((grown, grown), dtype=np.float32)
        gram[: self._count, : self._count] = self._gram[: self._count, : self._count]
        self._gram = gram

"""The last frames of a stream, and their inner products with all templates: estimated at once, exact on demand."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from smal.matching.inner_products import Columns
from smal.matching.template_index import TemplateIndex

Array = NDArray[np.float64]

#: Relative error of a float64 product that is kept in float32.
KEPT = 2.0**-24 * (1.0 + 1e-6)
# Templates that are converted to float64 at a time, so that they stay in the cache.
_TOGETHER = 64


class FrameRing:
    """Keeps l frames. Place t % l belongs to the frame that arrived as number t.

    Parameters
    ----------
    index : TemplateIndex
    length : int
        l.
    """

    def __init__(self, index: TemplateIndex, length: int) -> None:
        m, n = index.shape
        self._index, self._length = index, length
        self._frames = np.zeros((length, m))
        self._correlations = np.zeros((n, length), dtype=np.float32)
        self._radii = np.zeros((n, length), dtype=np.float32)
        self._exact = np.zeros((n, length), dtype=np.bool_)
        self._block = np.empty((_TOGETHER, m))
        self._norms = np.zeros(length)
        self.reset()

    def reset(self) -> None:
        """Forget all frames."""
        self._count = 0

    @property
    def index(self) -> TemplateIndex:
        """The templates."""
        return self._index

    @property
    def frames(self) -> Array:
        """Y^T by places, float64 (l, m)."""
        return self._frames

    @property
    def norms(self) -> Array:
        """||y_i|| by places, float64 (l,)."""
        return self._norms

    @property
    def held(self) -> int:
        """How many of the last frames are here, at most l."""
        return min(self._count, self._length)

    def observe(self, frame: NDArray[Any]) -> None:
        """Take a frame in, and correlate it with all templates.

        Raises
        ------
        ValueError
            Of another length, NaN or infinity; the frame is then not taken in.
        """
        if frame.shape != (self._frames.shape[1],):
            raise ValueError(f"a frame must have the shape ({self._frames.shape[1]},), got {frame.shape}")
        square = np.square(frame, dtype=np.float64).sum()
        if not np.isfinite(square):
            raise ValueError("the frame contains NaN or infinity")
        place = self._count % self._length
        self._frames[place], self._norms[place] = frame, np.sqrt(square)
        estimate = self._index.correlate(self._frames[place : place + 1])
        self._correlations[:, place] = estimate.values[:, 0]
        self._radii[:, place] = estimate.radii
        self._exact[:, place] = False
        self._count += 1

    def places(self, frames: int) -> Columns:
        """Where the last frames are, in order.

        Raises
        ------
        ValueError
            There are not so many, or never will be.
        """
        if not 1 <= frames <= self._length:
            raise ValueError(f"the last 1 to {self._length} frames can be asked for, not {frames}")
        if frames > self._count:
            raise ValueError(f"this needs {frames} frames, there are {self._count}")
        order: Columns = (self._count + np.arange(self._length - frames, self._length)) % self._length
        return order

    def estimates(
        self, places: Columns, columns: Columns | None = None
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """X_R^T Y of frames at these places (r, q), and how far each product may be from the truth; all R if None."""
        where = (slice(None), places) if columns is None else np.ix_(columns, places)
        return self._correlations[where], self._radii[where]

    def correlations(self, columns: Columns, places: Columns) -> NDArray[np.float32]:
        """X_R^T Y of template frames R (r,) and frames at places (q,), to the last digit of float32 (r, q)."""
        self.refine(columns, places)
        return self._correlations[np.ix_(columns, places)]

    def refine(self, columns: Columns, places: Columns) -> None:
        """Make these estimates exact to the last digit of float32, where they are not yet."""
        unknown = ~self._exact[np.ix_(columns, places)]
        if unknown.any():
            self._multiply(columns[unknown.any(axis=1)], places[unknown.any(axis=0)])

    def _multiply(self, columns: Columns, places: Columns) -> None:
        templates, query = self._index.templates.T, np.ascontiguousarray(self._frames[places].T)
        for start in range(0, columns.size, _TOGETHER):
            here = columns[start : start + _TOGETHER]
            block = self._block[: here.size]
            for row, column in zip(block, here, strict=True):
                row[:] = templates[column]
            where = np.ix_(here, places)
            self._correlations[where] = block @ query
            self._radii[where] = np.outer(self._index.lengths[here], self._norms[places] * (2.0 * KEPT))
            self._exact[where] = True

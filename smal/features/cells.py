"""Cells of a small picture: each pixel with its eight neighbours, normalised in brightness."""

from typing import Final

import numpy as np

from smal.arrays import AnyArray, Float32s
from smal.camera import Image

#: Numbers of a cell: it and its eight neighbours, in three colours.
NUMBERS: Final = 27


def cells_of(picture: Image, step: int = 1) -> Float32s:
    """Return every ``step``-th cell of a small picture, (rows, columns, 27), normalised in brightness."""
    light = picture.astype(np.float32) / max(2.0 * float(picture.mean()), 1.0)
    colours = np.sqrt(np.minimum(light, 1.5))
    edged = np.pad(colours, ((1, 1), (1, 1), (0, 0)), mode="edge")
    rows, columns = picture.shape[:2]
    cells = [edged[y : y + rows : step, x : x + columns : step] for y in range(3) for x in range(3)]
    return np.asarray(np.concatenate(cells, axis=-1), dtype=np.float32)


def nearest(cells: Float32s, codes: AnyArray) -> Float32s:
    """Return the distance of each cell (..., m) from the nearest code (n, m); infinite without codes."""
    flat = cells.reshape(-1, codes.shape[1])
    held = codes.astype(np.float32)
    if not len(held):
        return np.full(cells.shape[:-1], np.inf, dtype=np.float32)
    squares = (held * held).sum(axis=1) - 2.0 * flat @ held.T
    away = squares.min(axis=1) + (flat * flat).sum(axis=1)
    distance = np.sqrt(np.maximum(away, 0.0))
    return np.asarray(distance.reshape(cells.shape[:-1]), dtype=np.float32)

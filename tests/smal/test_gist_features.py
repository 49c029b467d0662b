"""GIST: what its filters respond to, and the same by another way of calculation."""

import numpy as np
import pytest

from smal.features import modality_named
from smal.features.gist import (
    COLUMNS,
    FREQUENCIES,
    GRID,
    ORIENTATIONS,
    ROWS,
)

describe = modality_named("gist").describe
SHAPE = (len(FREQUENCIES), ORIENTATIONS, GRID, GRID)


def grating(cycles_per_px: float, angle_rad: float, amplitude: float = 60.0) -> np.ndarray:
    down, right = np.mgrid[:ROWS, :COLUMNS]
    along = right * np.cos(angle_rad) + down * np.sin(angle_rad)
    grey = np.round(128.0 + amplitude * np.sin(2.0 * np.pi * cycles_per_px * along)).astype(
        np.uint8
    )
    return np.repeat(grey[:, :, None], 3, axis=2)


@pytest.mark.parametrize("scale", range(len(FREQUENCIES)))
@pytest.mark.parametrize("orientation", range(ORIENTATIONS))
def test_grating_responds_at_its_scale_and_orientation(scale: int, orientation: int) -> None:
    vector = describe(grating(FREQUENCIES[scale], np.pi * orientation / ORIENTATIONS)).reshape(
        SHAPE
    )
    for row, column in np.ndindex(GRID, GRID):
        cell = vector[:, :, row, column]
        assert np.unravel_index(cell.argmax(), cell.shape) == (scale, orientation)

"""GIST: what its filters respond to, and the same by another way of calculation."""

import numpy as np
import pytest

from smal.features import modality_named
from smal.features.gist import (
    BORDER,
    COLUMNS,
    FREQUENCIES,
    GRID,
    ORIENTATIONS,
    ROWS,
    mean_amplitudes,
    transfer_functions,
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
def test_a_grating_is_found_at_its_scale_and_orientation(scale: int, orientation: int) -> None:
    vector = describe(grating(FREQUENCIES[scale], np.pi * orientation / ORIENTATIONS)).reshape(
        SHAPE
    )
    for row, column in np.ndindex(GRID, GRID):
        cell = vector[:, :, row, column]
        assert np.unravel_index(cell.argmax(), cell.shape) == (scale, orientation)


@pytest.mark.parametrize(
    ("scale", "orientation", "cell"), [(0, 2, (0, 0)), (1, 0, (1, 2)), (3, 5, (3, 3))]
)
def test_the_transform_is_a_convolution(
    scale: int, orientation: int, cell: tuple[int, int]
) -> None:
    picture = np.random.default_rng(4).standard_normal((ROWS, COLUMNS)).astype(np.float32)
    padded = np.pad(picture.astype(np.float64), BORDER, mode="symmetric")
    rows, columns = padded.shape
    # The filter in space: the sum over its frequencies, written out as two matrix products.
    transfer = transfer_functions()[scale * ORIENTATIONS + orientation].astype(np.float64)
    waves = [
        np.exp(2j * np.pi * np.outer(np.arange(n), np.arange(n)) / n) / n for n in (rows, columns)
    ]
    kernel = waves[0] @ transfer @ waves[1].T
    total = 0.0
    height = ROWS // GRID
    width = COLUMNS // GRID
    for row in range(BORDER + cell[0] * height, BORDER + (cell[0] + 1) * height):
        for column in range(BORDER + cell[1] * width, BORDER + (cell[1] + 1) * width):
            # Pixel (i, j) counts with the kernel at (row - i, column - j), around the edges.
            turned = np.roll(kernel[::-1, ::-1], (row + 1, column + 1), axis=(0, 1))
            total += abs((padded * turned).sum())
    found = mean_amplitudes(picture)[scale * ORIENTATIONS + orientation][cell]
    assert found == pytest.approx(total / (height * width), rel=1e-4)

"""LDB: against its definition cell by cell."""

from itertools import combinations

import numpy as np
import pytest

from smal.features import modality_named
from smal.features.ldb import GRIDS, SIDE, SIZE

describe = modality_named("ldb").describe


def picture_of(seed: int, darkest: int = 0, brightest: int = 255, blocks: int = 10) -> np.ndarray:
    cells = np.random.default_rng(seed).integers(
        darkest, brightest + 1, (blocks, blocks), dtype=np.uint8
    )
    return np.repeat(
        np.kron(cells, np.ones((SIDE // blocks,) * 2, dtype=np.uint8))[:, :, None], 3, axis=2
    )


def slow_signs(grey: np.ndarray) -> np.ndarray:
    """Compare the means of cells and of their halves, one after the other, as the paper says it."""
    signs = []
    for grid in GRIDS:
        side = SIDE // grid
        cells = []
        for row, column in np.ndindex(grid, grid):
            cell = grey[row * side :, column * side :][:side, :side].astype(float)
            half = side // 2
            dx = cell[:, half:].mean() - cell[:, :half].mean()
            dy = cell[half:].mean() - cell[:half].mean()
            cells.append((cell.mean(), dx, dy))
        for kind in range(3):
            signs += [
                np.sign(round(one[kind] - other[kind], 6)) for one, other in combinations(cells, 2)
            ]
    return np.array(signs)


@pytest.mark.parametrize("seed", range(4))
def test_signs_are_those_of_the_definition(seed: int) -> None:
    picture = picture_of(seed)
    expected = slow_signs(picture[:, :, 0])
    assert len(expected) == SIZE
    np.testing.assert_array_equal(np.sign(describe(picture)), expected)

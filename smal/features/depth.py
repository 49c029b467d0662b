"""Depth modality: how near everything is, on a coarse grid.

Light, paint and exposure change colours and edges, but not distances: what this modality says of a place is
the same by day and by night.
"""

import numpy as np

from smal.arrays import Float32s, Uint16s
from smal.features.modality import unit_length
from smal.features.resizing import resized

ROWS = 24
COLUMNS = 32
SIZE = ROWS * COLUMNS

# At this distance, nearness is one half. Sensors err by more the farther something is, and there nearness hardly
# changes with distance; without the bound that it gives, 1/z would leave the closest surface alone to decide.
HALF_M = 5.0


def depth_descriptor(depth_mm: Uint16s) -> Float32s:
    """Describe a depth image, uint16 (height, width), by the nearness of what is seen, on a 24 x 32 grid, (768,).

    It has millimetres along the optical axis, 0 where nothing is in range, which is what the farthest surface tends to:
    nearness 0. That of a surface at z metres is HALF_M / (HALF_M + z): 1 at the camera. Means of the grid cells, row by
    row, are scaled to unit length; where nothing is in range there is no direction, but the zero vector.
    """
    half_mm = np.float32(1000.0 * HALF_M)
    nearness = np.where(
        depth_mm > 0, half_mm / (half_mm + depth_mm.astype(np.float32)), np.float32(0.0)
    )
    # Nearness is averaged, not depth: in a cell with a post before the sky there is no surface half way.
    return unit_length(resized(nearness, ROWS, COLUMNS))

"""Depth modality: nearness on a coarse grid.

Light, paint and exposure change colours and edges, but not distances: this modality is the same by day and by night.
"""

import numpy as np

from smal.arrays import Float32s, Uint16s
from smal.features.modality import unit_length
from smal.features.resizing import resized

ROWS = 24
COLUMNS = 32
SIZE = ROWS * COLUMNS

# At this distance, nearness is one half. Errors of sensors grow with the distance, where nearness hardly changes. The
# bound prevents the closest surface from dominating, as with 1/z.
HALF_M = 5.0


def depth_descriptor(depth_mm: Uint16s) -> Float32s:
    """Describe a depth image, uint16 (height, width), by the nearness on a 24 x 32 grid, (768,).

    Depth is in millimetres along the optical axis, 0 out of range, which is the limit of far surfaces: nearness 0. The
    nearness of a surface at z metres is HALF_M / (HALF_M + z): 1 at the camera. The means of the grid cells, row by
    row, are scaled to unit length. An image without any depth gives the zero vector.
    """
    half_mm = np.float32(1000.0 * HALF_M)
    nearness = half_mm / (half_mm + depth_mm.astype(np.float32))
    nearness = np.where(depth_mm > 0, nearness, np.float32(0.0))
    # Nearness is averaged, not depth: in a cell with a post before the sky there is no surface half way.
    return unit_length(resized(nearness, ROWS, COLUMNS))

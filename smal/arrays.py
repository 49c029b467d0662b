"""Array types by the type of their elements (docstrings give the shapes), and even selection."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Float32s = NDArray[np.float32]
Indices = NDArray[np.intp]
Int8s = NDArray[np.int8]
Int32s = NDArray[np.int32]
Int64s = NDArray[np.int64]
Uint8s = NDArray[np.uint8]
Uint16s = NDArray[np.uint16]
Bools = NDArray[np.bool_]
AnyArray = NDArray[Any]


def evenly(count: int, maximum: int) -> Indices:
    """Return evenly spread integers below `count`, at most `maximum` of them."""
    numbers = np.linspace(0, count - 1, min(count, maximum))
    return np.unique(numbers.astype(np.intp))

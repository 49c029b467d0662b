"""What every feature modality says of itself."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

# What a camera gives: RGB, uint8 (height, width, 3), or depth, uint16 (height, width) in millimetres.
Input = Literal["color", "depth"]


@dataclass(frozen=True)
class Modality:
    """One way to describe a frame.

    Parameters
    ----------
    size : int
        Entries of its descriptor.
    needs : "color" or "depth"
        Which image of the frame it describes.
    describe : function
        Makes the descriptor, float32 (size,), of unit length or zero, of that image.
    """

    size: int
    needs: Input
    describe: Callable[[NDArray[Any]], NDArray[np.float32]]

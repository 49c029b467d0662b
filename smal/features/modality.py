"""Interface of a feature modality."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from smal.arrays import AnyArray, Float32s, Uint8s
from smal.features.detectors import Detection
from smal.features.resizing import PIXELS

# Images of a camera: RGB, uint8 (height, width, 3), or depth, uint16 (height, width) in millimetres.
Input = Literal["color", "depth"]


@dataclass(frozen=True)
class Modality:
    """One way to describe a frame.

    Attributes
    ----------
    name
        Part of the fingerprint. It identifies the calculation, so a network is named by its contents.
    needs
        Image for `describe`, of any size from 32 x 24 on.
    describe
        Returns the descriptor, float32 (size,), of unit length or zero. A detector has an empty descriptor.
    detect
        Returns the detections of a detector.
    pixels
        Rows and columns of an image at which it looks, or more.
    """

    name: str
    size: int
    needs: Input
    describe: Callable[[AnyArray], Float32s]
    detect: Callable[[Uint8s], list[Detection]] | None = None
    pixels: tuple[int, int] = PIXELS


def detector(name: str, detect: Callable[[Uint8s], list[Detection]]) -> Modality:
    """Return the modality of a detector."""
    nothing = np.empty(0, dtype=np.float32)
    return Modality(name, 0, "color", lambda _image: nothing, detect)


def unit_length(values: AnyArray) -> Float32s:
    """Return all values as a float32 vector of unit length; zeros stay zero."""
    vector = np.asarray(values, dtype=np.float32).ravel()
    norm = float(np.linalg.norm(vector))
    return vector / np.float32(norm) if norm > 0.0 else vector

"""Interface of a feature modality."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from smal.arrays import AnyArray, Float32s, Uint8s
from smal.features.detectors import Detection

# What a camera gives: RGB, uint8 (height, width, 3), or depth, uint16 (height, width) in millimetres.
Input = Literal["color", "depth"]


@dataclass(frozen=True)
class Modality:
    """One way to describe a frame.

    The name is what a fingerprint calls it: it names the calculation and nothing else, so of a network its contents and
    not where its file lies. `needs` is the image of the frame, of any size from 32 x 24 on, that `describe` makes the
    descriptor of: float32 (size,), of unit length or zero. A detector has none, and finds things in a frame.
    """

    name: str
    size: int
    needs: Input
    describe: Callable[[AnyArray], Float32s]
    detect: Callable[[Uint8s], list[Detection]] | None = None


def detector(name: str, detect: Callable[[Uint8s], list[Detection]]) -> Modality:
    """Return the modality that a detector is."""
    return Modality(name, 0, "color", lambda _image: np.empty(0, dtype=np.float32), detect)


def unit_length(values: AnyArray) -> Float32s:
    """Return all values, in a row, as a float32 vector of unit length; zeros have no direction and stay."""
    vector = np.asarray(values, dtype=np.float32).ravel()
    norm = float(np.linalg.norm(vector))
    return vector / np.float32(norm) if norm > 0.0 else vector

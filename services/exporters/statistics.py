"""What a LeRobotDataset says of the values of each feature, for those who normalize them."""

from __future__ import annotations

from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

_QUANTILES: Final = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}
Statistics = dict[str, list[Any]]


def of_numbers(rows: NDArray[Any]) -> Statistics:
    """Return the statistics of values (n, width); the extremes are of their own type, as lerobot has it."""
    values = rows.astype(np.float64)
    found: dict[str, NDArray[Any]] = {"min": rows.min(axis=0), "max": rows.max(axis=0)}
    found |= {"mean": values.mean(axis=0), "std": values.std(axis=0)}
    found |= {name: np.quantile(values, share, axis=0) for name, share in _QUANTILES.items()}
    return {name: value.tolist() for name, value in found.items()} | {"count": [len(values)]}


def histogram(pixels: NDArray[np.uint8]) -> NDArray[np.int64]:
    """Count how often each value is in each channel of an image, (3, 256)."""
    counts = [cv2.calcHist([pixels], [channel], None, [256], [0.0, 256.0])[:, 0] for channel in range(3)]
    return np.stack(counts).astype(np.int64)


def of_images(counts: NDArray[np.int64], images: int) -> Statistics:
    """Return the statistics of images from the sum of their histograms; values are from 0 to 1, each (3, 1, 1)."""
    levels = np.arange(256) / 255.0
    shares = counts / counts.sum(axis=1, keepdims=True)
    mean = shares @ levels
    # Of rounding alone it can be less than nothing.
    variance = np.maximum(shares @ levels**2 - mean**2, 0.0)
    there = [levels[channel > 0] for channel in counts]
    found = {
        "min": np.array([one[0] for one in there]), "max": np.array([one[-1] for one in there]),
        "mean": mean, "std": np.sqrt(variance),
    }  # fmt: skip
    below = np.cumsum(shares, axis=1)
    found |= {name: levels[np.minimum((below < share).sum(axis=1), 255)] for name, share in _QUANTILES.items()}
    return {name: value.reshape(3, 1, 1).tolist() for name, value in found.items()} | {"count": [images]}

"""From the images of a frame to a raw feature vector."""

import os
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor
from typing import Final, Protocol, TypeVar

import numpy as np

from smal.arrays import AnyArray, Float32s, Uint8s, Uint16s
from smal.features import color
from smal.features.detectors import Detection
from smal.features.modalities import modality_named
from smal.features.modality import Input
from smal.features.resizing import shrunk
from smal.features.settings import FeatureSettings

#: Each worker holds one decoded image, up to 300 MB.
_WORKERS: Final = min(4, os.cpu_count() or 1)
Item = TypeVar("Item")
Answer = TypeVar("Answer")
#: In each thread of `in_parallel`: the event that its results are no longer needed.
_here = threading.local()


class Parallel(Protocol):
    """Yields the results of a function for each item, in order, as `map` of any `concurrent.futures.Executor`."""

    def __call__(
        self, function: Callable[[Item], Answer], items: Iterable[Item], /
    ) -> Iterator[Answer]:
        """Start."""
        ...


def in_parallel(function: Callable[[Item], Answer], items: Iterable[Item]) -> Iterator[Answer]:
    """Yield the results of a function for each item, in order; threads are at most a few items ahead."""
    waiting = deque[Future[Answer]]()
    over = threading.Event()

    def answer(item: Item) -> Answer:
        _here.over = over
        still_wanted()
        return function(item)

    with ThreadPoolExecutor(_WORKERS) as pool:
        try:
            for item in items:
                waiting.append(pool.submit(answer, item))
                if len(waiting) > 2 * _WORKERS:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            over.set()


def still_wanted() -> None:
    """Cancel a long computation in a thread of `in_parallel` without further need, as after Ctrl-C."""
    if hasattr(_here, "over") and _here.over.is_set():
        raise CancelledError


def looked_at(image: Uint8s, settings: FeatureSettings) -> Uint8s:
    """Shrink an RGB image (height, width, 3) to twice the pixels at which features look.

    Features, small pictures and virtual views are computed from it, so that they cost the same for
    every camera. Virtual views need the double resolution: they have other positions of pixels.
    ValueError as in `check_image`.
    """
    check_image(image)
    rows, columns = settings.pixels
    return shrunk(image, (2 * rows, 2 * columns))


def extract(image: Uint8s, settings: FeatureSettings, depth_mm: Uint16s | None = None) -> Float32s:
    """Compute the raw features (m,) of one frame.

    They are the descriptors of the modalities in a row, each of unit length (or zero, see the modality), and not
    centred (`Centering.apply`).

    Parameters
    ----------
    image : array (height, width, 3)
        RGB, uint8, at least 24 rows and 32 columns.
    settings : FeatureSettings
    depth_mm : array (height, width), optional
        Depth of the same view in millimetres, uint16, of any size; 0 out of range. The modality "depth" needs it.

    Raises
    ------
    ValueError
        If an image has the wrong type or shape or is too small, or a depth image is missing.
    """
    inputs: dict[Input, AnyArray] = {"color": np.ascontiguousarray(looked_at(image, settings))}
    if "depth" in settings.needs:
        if depth_mm is None:
            raise ValueError(f"the features {', '.join(settings.modalities)} need a depth image")
        if depth_mm.dtype != np.uint16:
            raise ValueError(
                f"a depth image must be an array of uint16 in millimetres, got {depth_mm.dtype}"
            )
        if depth_mm.ndim != 2 or depth_mm.size == 0:
            raise ValueError(
                f"a depth image must have the shape (height, width), got {depth_mm.shape}"
            )
        inputs["depth"] = np.ascontiguousarray(depth_mm)
    modalities = [modality_named(name) for name in settings.modalities]
    return np.concatenate([modality.describe(inputs[modality.needs]) for modality in modalities])


def detect(image: Uint8s, settings: FeatureSettings) -> list[Detection]:
    """Return the detections in an RGB image by the detectors among the modalities; ValueError if one does not run."""
    detectors = [modality_named(name).detect for name in settings.modalities]
    return [found for detector in detectors if detector is not None for found in detector(image)]


def check_image(image: Uint8s) -> None:
    """Raise ValueError if an image is invalid for `extract`."""
    if not isinstance(image, np.ndarray):
        raise ValueError(  # noqa: TRY004 - of one class with the errors below
            f"an image must be an array (height, width, 3), got {type(image).__name__}"
        )
    if image.dtype != np.uint8:
        raise ValueError(f"an image must be an array of uint8 (0 to 255), got {image.dtype}")
    if image.ndim != 3 or image.shape[2] != 3:
        raise ValueError(
            "an image must have three colours, the shape (height, width, 3), got "
            f"{image.shape}; repeat a grey image three times"
        )
    if image.shape[0] < color.ROWS or image.shape[1] < color.COLUMNS:
        raise ValueError(
            f"an image must have at least {color.ROWS} rows and {color.COLUMNS} columns, "
            f"got {image.shape[0]} x {image.shape[1]}"
        )

"""Resizing images of any camera to common sizes."""

from typing import Final

import numpy as np

from smal.arrays import AnyArray, Uint8s

#: Rows and columns of `small`: a lying person 5 m away takes 20 of the columns.
SHAPE: Final = (60, 80)
#: Rows and columns of an image at which features look: the finest of our own descriptors, HOG.
PIXELS: Final = (120, 160)
#: Ratio of two aspect ratios above which images show different views: 1 % is a row in a hundred.
_OTHER_SHAPE: Final = 1.01


def same_aspect(shape: tuple[int, ...], other: tuple[int, ...]) -> bool:
    """Return whether images of two shapes (rows, columns) can show the same view."""
    ratio = shape[0] * other[1] / (shape[1] * other[0])
    return 1.0 / _OTHER_SHAPE <= ratio <= _OTHER_SHAPE


def fitted(shape: tuple[int, ...], least: tuple[int, int]) -> tuple[int, int]:
    """Return the rows and columns of an image that is shrunk, but not below `least` on any side.

    The aspect ratio stays, so that the camera model fits every size.
    """
    rows, columns = shape[:2]
    factor = min(max(least[0] / rows, least[1] / columns), 1.0)
    return round(factor * rows), round(factor * columns)


def shrunk(image: Uint8s, least: tuple[int, int]) -> Uint8s:
    """Shrink an image (height, width, 3) to the size `fitted`; a shrunk image stays as it is."""
    shape = fitted(image.shape, least)
    rows, columns = image.shape[:2]
    # Halving is much faster than any other factor.
    while rows % 2 == columns % 2 == 0 and rows >= 2 * shape[0] and columns >= 2 * shape[1]:
        rows //= 2
        columns //= 2
        image = np.asarray(resized(image, rows, columns), dtype=np.uint8)
    return image if shape == (rows, columns) else np.asarray(resized(image, *shape), np.uint8)


def resized(image: AnyArray, rows: int, columns: int) -> AnyArray:
    """Resize an image (height, width) or (height, width, channels)."""
    import cv2  # noqa: PLC0415 - recognition reads the sizes of descriptors in an image without OpenCV

    shrinks = image.shape[0] >= rows and image.shape[1] >= columns
    # Area averaging is for shrinking only: enlarging with it repeats pixels and creates edges.
    method = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
    return cv2.resize(image, (columns, rows), interpolation=method)


def resized_grey(image: Uint8s, rows: int, columns: int) -> Uint8s:
    """Resize an RGB image (height, width, 3) to grey values (rows, columns)."""
    import cv2  # noqa: PLC0415 - see above

    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    return np.asarray(resized(grey, rows, columns), dtype=np.uint8)


def small(image: AnyArray) -> Uint8s:
    """Return the small picture (60, 80, 3) of an RGB image, the input of the target detector."""
    import cv2  # noqa: PLC0415 - see above

    picture = cv2.resize(image, SHAPE[::-1], interpolation=cv2.INTER_AREA)
    return np.asarray(picture, dtype=np.uint8)

"""Shift between two images: how far the robot is turned from a taught heading.

Dall'Osto et al. 2021 (github QVPR/teach-repeat): small grey images, normalised around each pixel, and their normalised
cross correlation over the columns.
"""

import numpy as np

from smal.arrays import Float32s, Uint8s

#: Size of compared images, and side of the square that normalises each pixel (theirs).
COLUMNS = 115
ROWS = 44
PATCH = 9


def prepared(image: Uint8s) -> Float32s:
    """Return a grey image (44, 115), normalised by mean and deviation of the square around each pixel, in [-1, 1]."""
    import cv2  # noqa: PLC0415 - see smal.features.hog

    grey = cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2GRAY)
    small = cv2.resize(grey, (COLUMNS, ROWS), interpolation=cv2.INTER_AREA).astype(np.float32)
    mean = cv2.blur(small, (PATCH, PATCH))
    # Deviations below one grey level are rounding.
    deviation = np.sqrt(np.maximum(cv2.blur(small * small, (PATCH, PATCH)) - mean * mean, 1.0))
    return np.clip((small - mean) / deviation, -1.0, 1.0).astype(np.float32)


def padded(image: Float32s) -> Float32s:
    """Return a prepared image as `turn_to` needs the taught one, with half of its width on both sides."""
    return np.pad(image, ((0, 0), (COLUMNS // 2, COLUMNS // 2)))


def turn_to(taught: Float32s, seen: Float32s, field_rad: float) -> tuple[float, float]:
    """Return the turn to the taught heading, radians to the left, and the correlation there.

    Parameters
    ----------
    taught : array
        From `padded`.
    seen : array
        From `prepared`.
    field_rad : float
        Horizontal field of view of the camera.
    """
    import cv2  # noqa: PLC0415 - see above

    correlations = cv2.matchTemplate(taught, seen, cv2.TM_CCOEFF_NORMED)[0]
    best = int(correlations.argmax())
    return (best - COLUMNS // 2) * field_rad / COLUMNS, float(correlations[best])

"""Detectors: signs that can be read, and boxes of a user's network.

A detector is listed among the modalities and adds nothing to the feature vector, because virtual views have no
detections. Its detections count in the search for a goal (`smal.target.label`).
"""

from collections.abc import Sequence
from functools import cache
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from smal.arrays import AnyArray, Uint8s

if TYPE_CHECKING:
    from cv2.aruco import ArucoDetector
    from cv2.typing import MatLike

LONGEST = 100  # Characters of a label; the text of a QR code is cut.


class Detection(NamedTuple):
    """One detection."""

    #: Name of the detector and of the object: "apriltag 7".
    label: str
    #: Confidence, 0 to 1.
    score: float
    #: Left, top, right, bottom: shares of the image's width and height.
    box: tuple[float, float, float, float]


def apriltags(image: Uint8s) -> list[Detection]:
    """Detect AprilTags of the family 36h11 in an RGB image; labels contain their numbers."""
    corners, numbers, _ = _tags().detectMarkers(_grey(image))
    # Without detections, the numbers are None.
    found = zip(numbers if corners else [], corners, strict=True)
    return [_sign("apriltag", int(number[0]), quad[0], image) for number, quad in found]


def qr_codes(image: Uint8s) -> list[Detection]:
    """Detect readable QR codes in an RGB image; labels contain their texts."""
    import cv2  # noqa: PLC0415 - see `smal.features.resizing`

    _, texts, corners, _ = cv2.QRCodeDetector().detectAndDecodeMulti(_grey(image))
    found = zip(texts, corners, strict=True)
    return [_sign("qr", text, quad, image) for text, quad in found if text]


def of_boxes(file: str, boxes: AnyArray, rows: int, columns: int) -> list[Detection]:
    """Return the detections of a network's first output (1, n, 6); ValueError for another shape.

    Each box is left, top, right, bottom in pixels of the network's input, a score from 0 to 1, and a class. Networks
    with built-in suppression have this output (YOLOv10; exports with `nms=True`).
    """
    if boxes.ndim != 3 or boxes.shape[0] != 1 or boxes.shape[2] != 6:
        raise ValueError(
            f"{file}: a detector's first output must be boxes (1, n, 6): left, top, right, bottom, score, class; "
            f"it has the shape {boxes.shape}"
        )
    shares = (boxes[0, :, :4] / (columns, rows, columns, rows)).clip(0.0, 1.0).tolist()
    scores = boxes[0, :, 4].clip(0.0, 1.0).tolist()
    classes = boxes[0, :, 5].tolist()
    return [
        Detection(f"boxes {kind:.0f}", score, (left, top, right, bottom))
        for (left, top, right, bottom), score, kind in zip(shares, scores, classes, strict=True)
    ]


@cache
def _tags() -> "ArucoDetector":
    import cv2  # noqa: PLC0415 - see `smal.features.resizing`

    return cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11))


def _grey(image: Uint8s) -> "MatLike":
    import cv2  # noqa: PLC0415 - see `smal.features.resizing`

    return cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)


def _sign(kind: str, name: object, corners: Sequence[Any], image: Uint8s) -> Detection:
    left, top = np.min(corners, axis=0).tolist()
    right, bottom = np.max(corners, axis=0).tolist()
    rows, columns = image.shape[:2]
    return Detection(
        f"{kind} {name}"[:LONGEST],
        1.0,
        (left / columns, top / rows, right / columns, bottom / rows),
    )

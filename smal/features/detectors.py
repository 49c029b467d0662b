"""What detectors find in an image: signs that can be read, and whatever a user's network draws boxes round.

A detector is named among the modalities, and adds nothing to the feature vector: where nobody drove its word would be
none. What it finds counts where a goal is looked for (`smal.sought.word`).
"""

from collections.abc import Sequence
from functools import cache
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from smal.arrays import AnyArray, Uint8s

if TYPE_CHECKING:
    from cv2.aruco import ArucoDetector
    from cv2.typing import MatLike

LONGEST = 100  # Characters of a label: of a longer text in a QR code the first.


class Detection(NamedTuple):
    """Something that a detector has found."""

    label: str  # The detector's name and which thing it is: "apriltag 7".
    score: float  # How sure the detector is, 0 to 1.
    box: tuple[
        float, float, float, float
    ]  # Left, top, right, bottom: shares of the image's width and height.


def apriltags(image: Uint8s) -> list[Detection]:
    """Find AprilTags of the family 36h11 in an RGB image; they have their numbers."""
    corners, numbers, _ = _tags().detectMarkers(_grey(image))
    # Without any, the numbers are None.
    return [
        _sign("apriltag", int(n[0]), quad[0], image)
        for n, quad in zip(numbers if corners else [], corners, strict=True)
    ]


def qr_codes(image: Uint8s) -> list[Detection]:
    """Find QR codes that can be read in an RGB image; they have their texts."""
    import cv2  # noqa: PLC0415 - see `smal.features.resizing`

    _, texts, corners, _ = cv2.QRCodeDetector().detectAndDecodeMulti(_grey(image))
    return [
        _sign("qr", text, quad, image) for text, quad in zip(texts, corners, strict=True) if text
    ]


def of_boxes(file: str, boxes: AnyArray, rows: int, columns: int) -> list[Detection]:
    """Return what a network's first output (1, n, 6) says of an image of its size; ValueError where it is no such one.

    Each box is left, top, right, bottom in pixels of the network's input, a score from 0 to 1, and a class: what
    networks give that choose among their boxes themselves (YOLOv10; exports with `nms=True`).
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
        Detection(f"boxes {of:.0f}", score, (left, top, right, bottom))
        for (left, top, right, bottom), score, of in zip(shares, scores, classes, strict=True)
        if score > 0.0 and left < right and top < bottom
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

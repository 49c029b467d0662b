"""Construction of ROS 2 messages from their fields, and conversion of their pixels."""

from collections.abc import Mapping
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from services.kit.jpeg import MOST_PIXELS

#: Maximum size of a message: a camera's maximum pixels with three bytes each, and a header.
LARGEST_BYTES: Final = 3 * MOST_PIXELS + 4096
#: Bytes of a pixel and its conversion to RGB, by the name of the encoding.
ENCODINGS: Final[dict[str, tuple[int, int | None]]] = {
    "rgb8": (3, None), "bgr8": (3, cv2.COLOR_BGR2RGB), "8UC3": (3, cv2.COLOR_BGR2RGB),
    "rgba8": (4, cv2.COLOR_RGBA2RGB), "bgra8": (4, cv2.COLOR_BGRA2RGB),
    "mono8": (1, cv2.COLOR_GRAY2RGB), "8UC1": (1, cv2.COLOR_GRAY2RGB),
    "yuv422": (2, cv2.COLOR_YUV2RGB_UYVY), "uyvy": (2, cv2.COLOR_YUV2RGB_UYVY),
    "yuv422_yuy2": (2, cv2.COLOR_YUV2RGB_YUY2), "yuyv": (2, cv2.COLOR_YUV2RGB_YUY2),
}  # fmt: skip


def ros_message(store: Any, kind: str, fields: Mapping[str, Any] | None = None) -> Any:  # noqa: ANN401 - without types
    """Create a message of a kind (``nav_msgs/msg/Odometry``); missing fields are zero or empty."""
    given = dict(fields or {})
    values = {
        name: _value(store, node, given.pop(name, None)) for name, node in store.fielddefs[kind][1]
    }
    if given:
        raise KeyError(f"{kind} has no {', '.join(given)}")
    return store.types[kind](**values)


def _value(store: Any, node: Any, value: Any) -> Any:  # noqa: ANN401 - as above
    sort = node[0].name
    about = node[1]
    if sort == "NAME":
        return ros_message(store, about, value)
    if sort == "BASE":
        return (
            ("" if about[0] == "string" else np.zeros(1, about[0])[0].item())
            if value is None
            else value
        )
    (inner, what), count = about
    if inner.name == "NAME":
        return [ros_message(store, what, one) for one in value or ()]
    return np.zeros(count, what[0]) if value is None else np.asarray(value, what[0])


def rgb_of(
    encoding: str, width: int, height: int, step: int, data: NDArray[np.uint8]
) -> NDArray[np.uint8]:
    """Return RGB pixels (height, width, 3) of rows of ``step`` bytes; ValueError if invalid."""
    if encoding not in ENCODINGS:
        raise ValueError(
            f"unsupported encoding {encoding[:30]!r}; supported are {', '.join(ENCODINGS)}"
        )
    size, conversion = ENCODINGS[encoding]
    if not (
        0 < width * height <= MOST_PIXELS and step >= width * size and data.size == step * height
    ):
        raise ValueError(
            f"invalid image: {width}x{height} pixels in {data.size} bytes, {step} per row"
        )
    if size == 2 and width % 2:
        raise ValueError(f"invalid width {width}: {encoding} needs an even number of columns")
    pixels = np.ascontiguousarray(data.reshape(height, step)[:, : width * size]).reshape(
        height, width, size
    )
    return (
        pixels
        if conversion is None
        else np.asarray(cv2.cvtColor(pixels, conversion), dtype=np.uint8)
    )

"""Construction of ROS 2 messages from their fields, and headings of their orientations."""

import math
from collections.abc import Mapping
from typing import Any, Final

import numpy as np

from services.kit.jpeg import MOST_PIXELS

#: Maximum size of a message: a camera's maximum pixels with three bytes each, and a header.
LARGEST_BYTES: Final = 3 * MOST_PIXELS + 4096


def heading_of(quaternion: Any) -> float:  # noqa: ANN401 - without types
    """Return the heading of an orientation, radians counter-clockwise; 0 for a zero quaternion."""
    q = quaternion
    sin = 2.0 * (q.w * q.z + q.x * q.y)
    # Powers of huge numbers raise an error; products are infinite.
    cos = q.w * q.w + q.x * q.x - q.y * q.y - q.z * q.z
    return math.atan2(sin, cos)


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

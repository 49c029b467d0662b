"""Messages of ROS 2 by what is in them, for types of the `rosbags` package, whose classes want every field."""

from collections.abc import Mapping
from typing import Any

import numpy as np


def ros_message(store: Any, kind: str, fields: Mapping[str, Any] | None = None) -> Any:  # noqa: ANN401 - without types
    """Return a message of a kind (``nav_msgs/msg/Odometry``); what its fields, maps in maps, lack is zero or empty."""
    given = dict(fields or {})
    made = {name: _value(store, node, given.pop(name, None)) for name, node in store.fielddefs[kind][1]}
    if given:
        raise KeyError(f"{kind} has no {', '.join(given)}")
    return store.types[kind](**made)


def _value(store: Any, node: Any, value: Any) -> Any:  # noqa: ANN401 - as above
    sort, about = node[0].name, node[1]
    if sort == "NAME":
        return ros_message(store, about, value)
    if sort == "BASE":
        return ("" if about[0] == "string" else np.zeros(1, about[0])[0].item()) if value is None else value
    (inner, what), count = about
    if inner.name == "NAME":
        return [ros_message(store, what, one) for one in value or ()]
    return np.zeros(count, what[0]) if value is None else np.asarray(value, what[0])

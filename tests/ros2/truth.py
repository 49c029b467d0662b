"""The true state of the fake robot: a small file that its processes and the tests share."""

from pathlib import Path

import numpy as np

_FIELDS = (
    *("t_s", "x", "y", "heading", "ahead_m_s", "turn_rad_s", "ordered_s", "collided", "orders"),
    *("put", "put_x", "put_y", "put_heading", "was_put", "victim", "frames"),
)


class Truth:
    """Named numbers in a file; each is written by one process."""

    def __init__(self, path: Path) -> None:
        if not path.exists():
            np.zeros(len(_FIELDS)).tofile(path)
        self._numbers = np.memmap(path, np.float64, "r+", shape=(len(_FIELDS),))

    def __getitem__(self, name: str) -> float:
        return float(self._numbers[_FIELDS.index(name)])

    def __setitem__(self, name: str, value: float) -> None:
        self._numbers[_FIELDS.index(name)] = value

    def put(self, x: float, y: float, heading: float) -> None:
        """Ask for the robot to be carried to a pose."""
        self["put_x"] = x
        self["put_y"] = y
        self["put_heading"] = heading
        self["put"] += 1

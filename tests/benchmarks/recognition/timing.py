"""Times of a call, and of two things as a ratio: measured in turn, so that both see the same state of the machine."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

Answer = TypeVar("Answer")


def seconds_of(call: Callable[[], Answer]) -> tuple[float, Answer]:
    """Call once; return the time and the answer."""
    began = time.perf_counter()
    answer = call()
    return time.perf_counter() - began, answer


def paired(unit: Callable[[], object], subject: Callable[[], object], repetitions: int) -> NDArray[np.float64]:
    """Time unit and subject in turn, after one pair that is not counted; return seconds (repetitions, 2)."""
    return np.array([[seconds_of(unit)[0], seconds_of(subject)[0]] for _ in range(repetitions + 1)])[1:]

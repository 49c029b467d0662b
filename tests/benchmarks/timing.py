"""Times of two things as a ratio: measured in turn, so that both see the same state of the machine."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

Answer = TypeVar("Answer")
#: Does what is not timed, and gives what is.
Prepare = Callable[[], Callable[[], Answer]]


@dataclass(frozen=True, eq=False)
class Paired(Generic[Answer]):
    """Times of pairs of one unit and one subject.

    Parameters
    ----------
    unit_s, subject_s : float64 arrays (repetitions,)
    answer
        Of the subject's last call.
    """

    unit_s: NDArray[np.float64]
    subject_s: NDArray[np.float64]
    answer: Answer

    @property
    def seconds(self) -> float:
        """Time of the subject, the median."""
        return float(np.median(self.subject_s))

    @property
    def ratio(self) -> float:
        """Subject over unit, the median over pairs."""
        return float(np.median(self.subject_s / self.unit_s))


def seconds_of(call: Callable[[], Answer]) -> tuple[float, Answer]:
    """Call once; return the time and the answer."""
    began = time.perf_counter()
    answer = call()
    return time.perf_counter() - began, answer


def paired(unit: Callable[[], object], prepare: Prepare[Answer], repetitions: int) -> Paired[Answer]:
    """Time unit and subject in turn, after one pair that is not counted."""
    times = np.empty((repetitions + 1, 2))
    answers: list[Answer] = []
    for k in range(repetitions + 1):
        subject = prepare()
        times[k, 0], _ = seconds_of(unit)
        times[k, 1], answer = seconds_of(subject)
        answers[:] = [answer]
    return Paired(times[1:, 0], times[1:, 1], answers[0])

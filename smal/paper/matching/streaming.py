"""Matching a stream of frames: the last l of them."""

from collections import deque
from typing import Any

import numpy as np
from numpy.typing import NDArray

from smal.paper.state_matching import Solution, check_parameters, solve, template_rows

Array = NDArray[np.float64]


class StreamingMatcher:
    """Keeps the last l frames and matches them.

    Parameters
    ----------
    templates : float array (m, n)
        X.
    sequence_length : int
        l.
    lambda1, lambda2 : float
        Of Eq. 7.
    tolerance : float
        Relative duality gap of each match.

    Raises
    ------
    ValueError
        Parameters out of range, or templates that are not finite.
    """

    def __init__(
        self, templates: NDArray[Any], sequence_length: int, lambda1: float, lambda2: float, tolerance: float = 1e-4
    ) -> None:
        # Prepared once, so that no match does it again.
        self._templates = template_rows(templates).T
        if not np.isfinite(self._templates).all():
            raise ValueError("templates contain NaN or infinity")
        check_parameters(self._templates.shape[1], sequence_length, lambda1, lambda2, tolerance)
        self._length, self._parameters = sequence_length, (lambda1, lambda2, tolerance)
        self.reset()

    def reset(self) -> None:
        """Forget all frames."""
        self._frames: deque[Array] = deque(maxlen=self._length)

    @property
    def ready(self) -> bool:
        """Whether l frames have arrived."""
        return len(self._frames) == self._length

    def observe(self, frame: NDArray[Any]) -> None:
        """Take a frame in.

        Parameters
        ----------
        frame : float array (m,)

        Raises
        ------
        ValueError
            Of another length, NaN or infinity; the frame is then not taken in.
        """
        if frame.shape != (self._templates.shape[0],):
            raise ValueError(f"a frame must have the shape ({self._templates.shape[0]},), got {frame.shape}")
        if not np.isfinite(frame).all():
            raise ValueError("the frame contains NaN or infinity")
        self._frames.append(frame.astype(np.float64))

    def window(self) -> Array:
        """Return the last l frames in order, float64 (l, m).

        Raises
        ------
        ValueError
            There are not so many.
        """
        if not self.ready:
            raise ValueError(f"this needs {self._length} frames, there are {len(self._frames)}")
        return np.stack(self._frames)

    def match(self) -> Solution:
        """Match the last l frames.

        Raises
        ------
        ValueError
            There are not so many.
        """
        return solve(self._templates, self.window().T, self._length, *self._parameters)


def compile_ahead() -> None:
    """Compile what matching needs, so that no robot waits for it; from the second time on that takes under a second."""
    matcher = StreamingMatcher(np.eye(8, dtype=np.float32), 2, 0.1, 0.1)
    for frame in np.eye(8, dtype=np.float32)[2:4]:
        matcher.observe(frame)
    matcher.match()

"""How a demonstration is cut into sequences of l frames."""

import numpy as np
from numpy.typing import NDArray


def first_frame(frames: int, sequence_length: int) -> int:
    """Frame at which the first sequence of a demonstration begins.

    Sequences are aligned to the end, so that the last frame (the victim in view) is in the last sequence; up
    to l - 1 frames at the start stay outside.
    """
    return frames % sequence_length


def last_frames(frames: int, sequence_length: int) -> NDArray[np.int64]:
    """Last frame of every sequence of a demonstration, int64 (f // l,)."""
    return np.arange(first_frame(frames, sequence_length), frames, sequence_length) + sequence_length - 1

"""How a demonstration is cut into sequences of l frames."""

import numpy as np

from smal.arrays import Int64s


def first_frame(frames: int, sequence_length: int) -> int:
    """First frame of the first sequence: they are aligned to the end, so that one has the last frame, the victim."""
    return frames % sequence_length


def last_frames(frames: int, sequence_length: int) -> Int64s:
    """Last frame of every sequence of a demonstration, int64 (f // l,)."""
    return (
        np.arange(first_frame(frames, sequence_length), frames, sequence_length)
        + sequence_length
        - 1
    )

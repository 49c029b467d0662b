"""Division of a demonstration into sequences of l frames."""

import numpy as np

from smal.arrays import Int64s


def first_frame(frames: int, sequence_length: int) -> int:
    """Return the first frame of the first sequence: sequences end with the last frame, which shows the victim."""
    return frames % sequence_length


def last_frames(frames: int, sequence_length: int) -> Int64s:
    """Return the last frame of every sequence of a demonstration, int64 (f // l,)."""
    starts = np.arange(first_frame(frames, sequence_length), frames, sequence_length)
    return starts + sequence_length - 1

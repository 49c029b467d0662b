"""What one picture says of what is sought, whoever looks at it: a patch (`sight`) or a detector (`word`)."""

from typing import Final, NamedTuple

import numpy as np

SCORES: Final = np.linspace(0.0, 1.0, 201)  # What scores are tabulated for.


class Said(NamedTuple):
    """What one picture says of what is sought."""

    log_ratio: float
    near: float  # How near it is, over how near it was where the taught ways ended.
    left: float  # As of a window.

"""Evidence of one picture for the target, by a patch (`sight`) or a detector (`word`)."""

from typing import Final, NamedTuple

import numpy as np

SCORES: Final = np.linspace(0.0, 1.0, 201)  # Grid of scores.


class Said(NamedTuple):
    """Evidence of one picture for the target."""

    log_ratio: float
    #: Distance to the target where the taught ways ended, over the distance now.
    near: float
    #: As in `Window`.
    left: float

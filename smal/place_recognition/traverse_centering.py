"""Centre each traverse by its own mean, which removes what its light, its season and its camera add.

Measured on traverses under other light, that changes more than any feature or length of a sequence does. But the mean
of few queries is what these few places look like; of a single one it is all that there is. It is therefore drawn
towards the mean of the references, as if some more frames had been seen.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from smal.features import Centering, FeatureSettings

#: As many frames that look like the references in the mean are counted among the queries.
PRIOR_FRAMES: Final = 5


def centre_traverses(
    references: NDArray[np.float32], queries: NDArray[np.float32], settings: FeatureSettings
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Centre two traverses, raw features (n, m) and (q, m), and weight their modalities; see `Centering.apply`."""
    known, own = Centering.fit(references, settings), Centering.fit(queries, settings)
    share = np.float32(queries.shape[0] / (queries.shape[0] + PRIOR_FRAMES))
    seen = Centering(share * own.mean + (1 - share) * known.mean, settings)
    return known.apply(references), seen.apply(queries)

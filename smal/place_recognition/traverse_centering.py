"""Centre each traverse by its own mean, which removes what its light, its season and its camera add.

Measured on traverses under other light, that changes more than any feature or length of a sequence does. But the mean
of few queries is what these few places look like; of a single one it is all that there is. It is therefore drawn
towards the mean of the references, as if some more frames had been seen.
"""

from typing import Final

import numpy as np

from smal.arrays import AnyArray, Float32s
from smal.features import Centering, FeatureSettings

PRIOR_FRAMES: Final = (
    5  # As many frames that look like the references in the mean are counted among the queries.
)


def centre_traverses(
    references: AnyArray,
    queries: AnyArray,
    settings: FeatureSettings,
    *,
    causal: bool = False,
) -> tuple[Float32s, Float32s]:
    """Centre two traverses, raw features (n, m) and (q, m); if causal, each query by the mean of those up to it."""
    known = Centering.fit(references, settings)
    total = PRIOR_FRAMES * known.mean.astype(np.float64)
    asked = np.empty(queries.shape, np.float32)
    if not causal:
        mean = (total + queries.sum(axis=0, dtype=np.float64)) / (len(queries) + PRIOR_FRAMES)
        return known.apply(references), Centering(mean.astype(np.float32), settings).apply(queries)
    for seen, query in enumerate(queries, start=1):
        total += query
        asked[seen - 1] = Centering(
            (total / (seen + PRIOR_FRAMES)).astype(np.float32), settings
        ).apply(query)
    return known.apply(references), asked

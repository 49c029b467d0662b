"""Centering of each traverse by its own mean, which removes the effect of its light, its season and its camera.

On traverses under different light, this improves matching more than any feature or sequence length. But the mean of few
queries describes these few places. Therefore it is shrunk towards the mean of the references, as if a few more frames
had been observed.
"""

from typing import Final

import numpy as np

from smal.arrays import AnyArray, Float32s, Floats
from smal.features import Centering, FeatureSettings

#: Weight of the references' mean in the queries' mean, as a number of frames.
PRIOR_FRAMES: Final = 5


def centre_traverses(
    references: AnyArray,
    queries: AnyArray,
    settings: FeatureSettings,
    *,
    causal: bool = False,
) -> tuple[Float32s, Float32s]:
    """Centre two traverses, raw features (n, m) and (q, m); if causal, each query by the mean up to it."""
    known = Centering.fit(references, settings)
    total = PRIOR_FRAMES * known.mean.astype(np.float64)

    def centred(rows: AnyArray, total: Floats, count: int) -> Float32s:
        mean = total / (count + PRIOR_FRAMES)
        return Centering(mean.astype(np.float32), settings).apply(rows)

    if not causal:
        total = total + queries.sum(axis=0, dtype=np.float64)
        return known.apply(references), centred(queries, total, len(queries))
    asked = np.empty(queries.shape, np.float32)
    for count, query in enumerate(queries, start=1):
        total += query
        asked[count - 1] = centred(query, total, count)
    return known.apply(references), asked

"""Traverses are centred by what they have in common, of which few queries say little."""

import numpy as np
import pytest

from smal.features import Centering, FeatureSettings
from smal.place_recognition.traverse_centering import PRIOR_FRAMES, centre_traverses

SETTINGS = FeatureSettings.of(("color", "thumbnail"))
RNG = np.random.default_rng(0)
REFERENCES = RNG.normal(size=(40, SETTINGS.size)).astype(np.float32)


def test_many_queries_are_centred_by_their_own_mean() -> None:
    light = RNG.normal(size=SETTINGS.size)
    queries = (RNG.normal(size=(400, SETTINGS.size)) + light).astype(np.float32)
    references, seen = centre_traverses(REFERENCES, queries, SETTINGS)
    np.testing.assert_array_equal(references, Centering.fit(REFERENCES, SETTINGS).apply(REFERENCES))
    own = Centering.fit(queries, SETTINGS).apply(queries)
    assert np.einsum("qm,qm->q", seen, own).min() > 0.999


@pytest.mark.parametrize("count", [1, PRIOR_FRAMES, 3 * PRIOR_FRAMES])
def test_the_prior_counts_as_some_frames(count: int) -> None:
    queries = RNG.normal(size=(count, SETTINGS.size)).astype(np.float32)
    frames = np.concatenate([queries, np.tile(REFERENCES.mean(axis=0), (PRIOR_FRAMES, 1))])
    expected = Centering.fit(frames, SETTINGS).apply(queries)
    np.testing.assert_allclose(centre_traverses(REFERENCES, queries, SETTINGS)[1], expected, atol=1e-4)


def test_if_causal_no_query_knows_of_later_ones() -> None:
    queries = RNG.normal(size=(30, SETTINGS.size)).astype(np.float32)
    causal = centre_traverses(REFERENCES, queries, SETTINGS, causal=True)[1]
    for seen in (1, 7, 30):
        known = centre_traverses(REFERENCES, queries[:seen], SETTINGS)[1]
        np.testing.assert_allclose(causal[seen - 1], known[-1], atol=1e-4)

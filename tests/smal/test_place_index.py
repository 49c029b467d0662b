"""The index of views: nothing gets lost in its lists, and what it gives is what looking at all views gives."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from smal.place_index import PlaceIndex


def views(seed: int, count: int, size: int = 16) -> NDArray[np.float32]:
    """Return views (count, size) along a way, of length 1."""
    steps = np.random.default_rng(seed).standard_normal((count + 7, size))
    summed = np.array([steps[place : place + 8].sum(axis=0) for place in range(count)])
    return (summed / np.linalg.norm(summed, axis=1, keepdims=True)).astype(np.float32)


@given(st.integers(0, 2**32 - 1), st.integers(1, 300), st.integers(1, 400))
def test_there_are_as_many_candidates_as_were_asked_for(seed: int, count: int, wanted: int) -> None:
    vectors = views(seed, count)
    near = PlaceIndex.build(vectors).near(vectors[0], wanted)
    assert np.unique(near).size == near.size >= min(wanted, count)
    assert ((near >= 0) & (near < count)).all()
    if wanted >= count:
        assert sorted(near.tolist()) == list(range(count))


def test_the_nearest_views_are_those_of_all(tmp_path: Path) -> None:
    """One in ten is looked at; the views lie on disk, as float16."""
    vectors = views(0, 4000)
    np.save(tmp_path / "views.npy", vectors.astype(np.float16))
    mapped = np.load(tmp_path / "views.npy", mmap_mode="r")
    index = PlaceIndex.build(mapped)
    rng = np.random.default_rng(1)
    places = rng.integers(0, 4000, 200)
    queries = vectors[places] + 0.15 * rng.standard_normal((200, 16)).astype(np.float32)
    best = (vectors @ queries.T).argmax(axis=0)
    near = [index.near(query, 400) for query in queries]
    assert np.mean([one in some for one, some in zip(best, near, strict=True)]) > 0.9
    assert np.mean([some.size for some in near]) < 600

"""Synthetic worlds: feature vectors along a corridor, without a camera."""

import numpy as np
from numpy.typing import NDArray

from smal.features import FeatureSettings
from smal.movement import Atom
from smal.teaching.demonstration import Demonstration

COLOR = FeatureSettings(("color",))


def unit(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Scale vectors to length 1; zero stays zero."""
    lengths = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.asarray(vectors / np.where(lengths > 0.0, lengths, 1.0))


def corridor(
    places: int, size: int = COLOR.size, seed: int = 0, smooth: float = 0.35
) -> NDArray[np.float64]:
    """Make views (places, size) by a random walk, each resembling the next."""
    rng = np.random.default_rng(seed)
    view = unit(rng.standard_normal(size))
    views = []
    for _ in range(places):
        view = unit(view + smooth * unit(rng.standard_normal(size)))
        views.append(view)
    return np.array(views)


def drive(
    views: NDArray[np.float64],
    start: int,
    seed: int,
    noise: float = 0.3,
    name: str = "drive",
    end: int | None = None,
) -> Demonstration:
    """Drive forward from one place to the end, with two turns on the way; each place is one frame."""
    rng = np.random.default_rng(seed)
    seen = views[start:end]
    features = unit(seen + noise * unit(rng.standard_normal(seen.shape)))
    where = np.arange(start, start + len(seen))
    atoms = np.full(len(seen), Atom.FORWARD, dtype=np.int8)
    atoms[(where // 10) % 3 == 1] = Atom.LEFT
    atoms[(where // 10) % 3 == 2] = Atom.RIGHT
    return Demonstration(
        name,
        features.astype(np.float32),
        atoms,
        successful=end is None or end == len(views),
        recovery=False,
    )


def matching_problem(
    seed: int,
    blocks: int,
    length: int,
    size: int = 60,
    noise: float = 0.5,
    smooth: float = 0.3,
    mixed: int = 1,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Templates (size, blocks * length) and a query (size, length) that mixes some of their sequences."""
    rng = np.random.default_rng(seed)
    templates = np.concatenate(
        [corridor(length, size, int(s), smooth) for s in rng.integers(2**31, size=blocks)]
    )
    shift = int(rng.integers(0, length // 2 + 1))
    rows = np.minimum(np.arange(length) + shift, length - 1)
    query = sum(templates[block * length + rows] for block in range(min(mixed, blocks)))
    query = unit(unit(np.asarray(query)) + noise * unit(rng.standard_normal((length, size))))
    return np.asfortranarray(templates.T.astype(np.float32)), np.asfortranarray(
        query.T.astype(np.float32)
    )

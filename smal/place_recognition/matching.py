"""`smal.match`: two traverses that somebody has as arrays."""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import partial

import numpy as np

from smal.arrays import AnyArray, Float32s
from smal.features import FeatureSettings, extract
from smal.features.extraction import Parallel, in_parallel
from smal.place_recognition.matches import Matches, check_features, ignore
from smal.place_recognition.methods import METHODS, MatchSettings

Frames = Iterable[
    AnyArray
]  # Images in order, uint8 (height, width, 3), or features of all, (n, m).


@dataclass(frozen=True)
class _Given(FeatureSettings):
    """Features of which nothing is known but their size, as one modality."""

    modalities: tuple[str, ...] = ("given",)
    size: int = 0

    def __post_init__(self) -> None:
        pass

    @property
    def slices(self) -> tuple[slice, ...]:
        return (slice(0, self.size),)


def match(
    references: Frames,
    queries: Frames | None = None,
    *,
    method: str = "smal",
    features: FeatureSettings | None = None,
    tolerance: int | None = None,
    lag: int | None = None,
    parallel: Parallel = in_parallel,
) -> Matches:
    """Find for each query the reference that was taken at the same place.

    Both are RGB images in order, uint8 (height, width, 3), at least 24 rows and 32 columns, or raw features of any
    kind, float (n, m) and (q, m). Without queries the references are matched with those long before them (loops).

    The method is one of `smal.place_recognition.methods.METHODS`. Only `smal` has loops; a tolerance, references so
    many frames away being right as well (if None, those that look alike); and a lag, how many later queries answer
    a query (if None, all). Features describe images (if None, the method's), or are the modalities of those that
    are given (if None, all are one). `parallel` describes images and, of the method `smal`, compares them; threads if
    not given. ValueError where there is no such method, it has not got what is chosen, or inputs are others.
    """
    if method not in METHODS:
        raise ValueError(f"unknown method {method!r}; known are {', '.join(METHODS)}")
    way = METHODS[method]
    if not way.probable and (queries is None or (tolerance, lag) != (None, None)):
        raise ValueError(f"the method {method} has no loops, no tolerance and no lag")
    settings = features or way.features
    known = _raw(references, settings, parallel)
    asked = known if queries is None else _raw(queries, settings, parallel)
    check_features(known, asked)
    if not way.any_features and (settings != way.features or known.shape[1] != settings.size):
        raise ValueError(
            f"the method {method} has its own features, {', '.join(way.features.modalities)}"
        )
    if features is None and known.shape[1] != settings.size:
        settings = _Given(size=known.shape[1])
    chosen = MatchSettings(
        settings, way.length, tolerance, lag, loops=queries is None, parallel=parallel
    )
    return way.match(known, asked, chosen, ignore)


def _raw(frames: Frames, settings: FeatureSettings, parallel: Parallel) -> Float32s:
    """Return features as they are given, or those of images."""
    if isinstance(frames, np.ndarray) and frames.ndim == 2:
        return np.asarray(frames, dtype=np.float32)
    described = list(parallel(partial(extract, settings=settings), frames))
    return np.array(described, dtype=np.float32).reshape(-1, settings.size)

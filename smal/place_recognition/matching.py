"""`smal.match`: place recognition on two traverses given as arrays."""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import partial

import numpy as np

from smal.arrays import AnyArray, Float32s
from smal.features import FeatureSettings, extract
from smal.features.extraction import Parallel, in_parallel
from smal.place_recognition.matches import Matches, check_features, ignore
from smal.place_recognition.methods import METHODS, MatchSettings

#: Images in order, uint8 (height, width, 3), or features of all, (n, m).
Frames = Iterable[AnyArray]


@dataclass(frozen=True)
class _Given(FeatureSettings):
    """Features of unknown meaning, as one modality."""

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
    """Find for each query the reference at the same place.

    Parameters
    ----------
    references, queries
        RGB images in order, uint8 (height, width, 3), at least 24 rows and 32 columns, or raw features of any kind,
        float (n, m) and (q, m). Without queries, the references are matched with references long before (loops).
    method : str
        One of `smal.place_recognition.methods.METHODS`. Only `smal` has loops, a tolerance and a lag.
    features : FeatureSettings, optional
        Features of images, by default those of the method; or the modalities of given features, by default one.
    tolerance : int, optional
        Distance in frames within which references are right; by default the distance within which they look alike.
    lag : int, optional
        Number of later queries that contribute to an answer; by default all.
    parallel : callable
        Describes images, and compares them for the method `smal`; by default threads.

    Raises
    ------
    ValueError
        If the method is unknown or lacks an option, or the input is invalid.
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
    """Return given features, or the features of images."""
    if isinstance(frames, np.ndarray) and frames.ndim == 2:
        return np.asarray(frames, dtype=np.float32)
    described = list(parallel(partial(extract, settings=settings), frames))
    return np.array(described, dtype=np.float32).reshape(-1, settings.size)

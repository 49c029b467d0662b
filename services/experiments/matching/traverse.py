"""Features of a traverse: images are decoded and described in parallel, with a cache."""

from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from schemas.codec import printable
from services.experiments.engine import Engine
from services.experiments.matching.feature_cache import FeatureCache, Features
from services.experiments.matching.sources import (
    Picture,
    TraverseSource,
    loaded,
    quiet_opencv,
    read_color,
    read_depth,
)
from services.experiments.progress import bar_of
from services.experiments.words import listed, remark
from services.kit.errors import JobError
from smal.features import FeatureSettings, extract
from smal.features.extraction import in_parallel


@dataclass(frozen=True, eq=False)
class Traverse:
    """A source with the raw features (n, m) of its readable frames and their numbers (n,)."""

    source: TraverseSource
    features: Features
    numbers: NDArray[np.int64]

    @property
    def unreadable(self) -> list[str]:
        """Names of the unreadable frames."""
        known = set(self.numbers.tolist())
        return [name for number, name in enumerate(self.source.frames) if number not in known]

    def say_skipped(self) -> None:
        """Report the skipped files on standard error."""
        skipped = {
            "no images": self.source.others,
            "unreadable (numbers kept)": self.unreadable,
        }
        said = {
            why: f"skipped {len(names)}, {why}: {_named(names)}"
            for why, names in skipped.items()
            if names
        }
        remark(f"{self.source.path}: {line}" for line in said.values())


class _Frame(NamedTuple):
    name: str
    key: bytes | None = None
    # Content of the colour image and, if any, of the depth image.
    read: Sequence[bytes] = ()
    known: Features | None = None


def describe_frames(
    source: TraverseSource,
    settings: FeatureSettings,
    depth: TraverseSource | None,
    title: str,
    engine: Engine,
) -> Traverse:
    """Compute the features of frames, with depth images if needed; raise JobError if that fails."""
    count = len(source.frames)
    try:
        features = np.zeros((count, settings.size), dtype=np.float16)
    except MemoryError:
        raise JobError(f"{source.path}: out of memory for the features of {count} frames") from None
    numbers: list[int] = []
    frames = zip(
        source.frames, *[one.pictures() for one in (source, depth) if one is not None], strict=True
    )
    with quiet_opencv(), closing(FeatureCache(settings)) as cache:
        looked_up = in_parallel(partial(_looked_up, cache), frames)
        described = engine.map(partial(_described, str(source.path), settings), looked_up)
        bar = bar_of(described, desc=title, total=count, unit="image")
        for number, (key, one) in enumerate(bar):
            if one is not None:
                features[len(numbers)] = one if key is None else cache.keep(key, one)
                numbers.append(number)
    if not numbers:
        without = (
            ""
            if depth is None
            else f" with a depth image, of one channel of 16 bits, in {depth.path}"
        )
        raise JobError(f"{source.path}: no readable image{without}: {_named(source.frames)}")
    return Traverse(source, features[: len(numbers)], np.array(numbers, np.int64))


def _looked_up(cache: FeatureCache, frame: tuple[str, *tuple[Picture, ...]]) -> _Frame:
    """Return the cached features of a frame, or its content to compute them; None if unreadable."""
    name, *pictures = frame
    read = [data for data in map(loaded, pictures) if data is not None]
    if len(read) < len(pictures):
        return _Frame(name)
    key = cache.key(*read)
    known = cache.find(key)
    return _Frame(name, key, read) if known is None else _Frame(name, known=known)


def _described(
    path: str, settings: FeatureSettings, frame: _Frame
) -> tuple[bytes | None, Features | None]:
    """Return the raw features of a frame, with the cache key if they are new; None if unreadable."""
    if not frame.read:
        return None, frame.known
    image = read_color(frame.read[0])
    depths_mm = [read_depth(one) for one in frame.read[1:]]
    if image is None or any(depth_mm is None for depth_mm in depths_mm):
        return None, None
    try:
        return frame.key, extract(image, settings, *depths_mm).astype(np.float16)
    except ValueError as error:
        raise JobError(f"{path}: {printable(frame.name, 255)}: {error}") from None


def _named(names: Sequence[str]) -> str:
    return listed([printable(name, 255) for name in names])

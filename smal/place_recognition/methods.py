"""The table of methods."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from smal.features import FeatureSettings
from smal.place_recognition.matches import Matches, Progress

#: (references (n, m), queries (q, m), features, sequence length, progress) -> matches; raw features of `extract`.
Match = Callable[[NDArray[np.float32], NDArray[np.float32], FeatureSettings, int, Progress], Matches]


@dataclass(frozen=True)
class Method:
    """One way to recognise places.

    Parameters
    ----------
    meaning : str
        One line for people.
    features : FeatureSettings
        What it looks at unless told otherwise.
    length : int
        Frames of a window unless told otherwise, at least 1.
    match : callable
        See `Match`. Of fewer than `length` references or queries it finds no match.
    any_features : bool
        Whether it works with other features than its own.
    any_length : bool
        Whether it works with other lengths than its own.
    """

    meaning: str
    features: FeatureSettings
    length: int
    match: Match
    any_features: bool = True
    any_length: bool = True


METHODS: Mapping[str, Method] = MappingProxyType({})

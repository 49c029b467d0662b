"""Table of the methods of place recognition."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from smal.arrays import Float32s
from smal.features import Centering, FeatureSettings
from smal.features.extraction import Parallel, in_parallel
from smal.place_recognition.matches import Matches, Progress
from smal.place_recognition.nearest_sequence import match_nearest_sequence
from smal.place_recognition.paper_matching import match_as_in_the_paper
from smal.place_recognition.places import match_places
from smal.place_recognition.seqslam import match_seqslam
from smal.place_recognition.traverse_centering import centre_traverses

Features = Float32s | NDArray[np.float16]


@dataclass(frozen=True)
class MatchSettings:
    """Options of a method, for `smal` as in `match_places`; for loops the queries are the references.

    `parallel` runs the parts of a method, if any.
    """

    features: FeatureSettings
    length: int = 1
    tolerance: int | None = None
    lag: int | None = None
    loops: bool = False
    parallel: Parallel = in_parallel


#: (references (n, m), queries (q, m), settings, progress) -> matches; raw features of `extract`, whole windows.
Match = Callable[[Features, Features, MatchSettings, Progress], Matches]


@dataclass(frozen=True)
class Method:
    """A method of place recognition, with its own features and its number of frames a window."""

    meaning: str
    features: FeatureSettings
    way: Match
    length: int = 1
    #: Whether it accepts other features than its own, and windows of other lengths.
    any_features: bool = True
    any_length: bool = True
    #: Whether scores are probabilities of being right; then it accepts a tolerance and a lag.
    probable: bool = False

    def match(
        self, references: Features, queries: Features, settings: MatchSettings, progress: Progress
    ) -> Matches:
        """Match raw features (n, m) and (q, m); with fewer than `length` of either there is no match."""
        # A traverse without frames has no mean.
        if min(len(references), len(queries)) < settings.length:
            progress(len(queries))
            return Matches.none(len(queries))
        return self.way(references, queries, settings, progress)


def _smal(
    references: Features, queries: Features, settings: MatchSettings, progress: Progress
) -> Matches:
    features = settings.features
    if settings.loops:
        centred = (Centering.fit(references, features).apply(references),) * 2
    else:
        causal = settings.lag is not None
        centred = centre_traverses(references, queries, features, causal=causal)
    return match_places(
        *centred,
        settings.tolerance,
        settings.lag,
        progress,
        settings.parallel,
        loops=settings.loops,
    )


def _nearest(
    references: Features, queries: Features, settings: MatchSettings, progress: Progress
) -> Matches:
    centred = centre_traverses(references, queries, settings.features)
    return match_nearest_sequence(*centred, settings.length, progress)


def _seqslam(
    references: Features, queries: Features, settings: MatchSettings, progress: Progress
) -> Matches:
    return match_seqslam(
        references.astype(np.float32), queries.astype(np.float32), settings.length, progress
    )


def _paper(
    references: Features, queries: Features, settings: MatchSettings, progress: Progress
) -> Matches:
    mean = Centering.fit(references, settings.features)
    return match_as_in_the_paper(
        mean.apply(references), mean.apply(queries), settings.length, progress
    )


#: They change little with light and season.
FEATURES = FeatureSettings.of(("color", "hog", "gist", "thumbnail"))

METHODS: Final = {
    "smal": Method(
        "a hidden Markov model over places, speeds and 'no reference shows it'; the score is a probability",
        FEATURES, _smal, any_length=False, probable=True,
    ),
    "nearest": Method("largest sum of products along the sequence, at equal speeds", FEATURES, _nearest, 10),
    "seqslam": Method(
        "Milford and Wyeth 2012", FeatureSettings.of(("thumbnail",)), _seqslam, 10, any_features=False
    ),
    "paper": Method(
        "Eq. 7 as published, with colour and HOG: sequences without order, cut at fixed phases",
        FeatureSettings(), _paper, 10,
    ),
    "image": Method("the paper's baseline: Eq. 7 of single images", FeatureSettings(), _paper, any_length=False),
}  # fmt: skip

"""The table of methods."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from smal.features import Centering, FeatureSettings
from smal.place_recognition.as_published import LAMBDA_SCALE, match_as_in_the_paper
from smal.place_recognition.matches import Matches, Progress
from smal.place_recognition.nearest_sequence import match_nearest_sequence
from smal.place_recognition.seqslam import SeqSlamSettings, match_seqslam
from smal.place_recognition.traverse_centering import centre_traverses
from smal.place_recognition.traverse_matching import OrderedSettings, match_traverses

Features = NDArray[np.float32]


@dataclass(frozen=True)
class MatchSettings:
    """What can be chosen of a method.

    Parameters
    ----------
    features : FeatureSettings
    length : int
        Frames l of a window, at least 1.
    penalty : float, optional
        Its own if None. With `smal` and `image` lambda as a share of the smallest one for which W = 0, above 0 and
        below 1; with `paper` a in lambda1 = lambda2 = a sqrt(l), above 0.
    """

    features: FeatureSettings
    length: int
    penalty: float | None = None


#: (references (n, m), queries (q, m), settings, progress) -> matches; raw features of `extract`.
Match = Callable[[Features, Features, MatchSettings, Progress], Matches]


@dataclass(frozen=True)
class Method:
    """One way to recognize places.

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
    penalty : float, optional
        Weight of its regularization unless told otherwise; None if it has none.
    any_features : bool
        Whether it works with other features than its own.
    any_length : bool
        Whether it works with other lengths than its own.
    """

    meaning: str
    features: FeatureSettings
    length: int
    match: Match
    penalty: float | None = None
    any_features: bool = True
    any_length: bool = True


def _of_whole_windows(match: Match) -> Match:
    """Answer for a method where no window is whole: a traverse without frames has no mean to be centred by."""

    def matched(references: Features, queries: Features, settings: MatchSettings, progress: Progress) -> Matches:
        if min(len(references), len(queries)) < settings.length:
            progress(len(queries))
            return Matches.none(len(queries))
        return match(references, queries, settings, progress)

    return matched


@_of_whole_windows
def _smal(references: Features, queries: Features, settings: MatchSettings, progress: Progress) -> Matches:
    own = {} if settings.penalty is None else {"relative_penalty": settings.penalty}
    centred = centre_traverses(references, queries, settings.features)
    return match_traverses(*centred, OrderedSettings(length=settings.length, **own), progress)


@_of_whole_windows
def _nearest(references: Features, queries: Features, settings: MatchSettings, progress: Progress) -> Matches:
    centred = centre_traverses(references, queries, settings.features)
    return match_nearest_sequence(*centred, settings.length, progress)


@_of_whole_windows
def _seqslam(references: Features, queries: Features, settings: MatchSettings, progress: Progress) -> Matches:
    return match_seqslam(references, queries, SeqSlamSettings(length=settings.length), progress)


@_of_whole_windows
def _paper(references: Features, queries: Features, settings: MatchSettings, progress: Progress) -> Matches:
    mean = Centering.fit(references, settings.features)
    scale = LAMBDA_SCALE if settings.penalty is None else settings.penalty
    return match_as_in_the_paper(mean.apply(references), mean.apply(queries), settings.length, scale, progress)


#: What looks at the whole image, and changes little where light and season do.
FEATURES = FeatureSettings.of(("color", "hog", "gist", "thumbnail"))
_PENALTY = OrderedSettings().relative_penalty

METHODS: Mapping[str, Method] = MappingProxyType(
    {
        "smal": Method(
            "the paper's sparse convex matching, with sequences in order and at speeds from half to twice",
            FEATURES, 10, _smal, _PENALTY,
        ),
        "image": Method(
            "the paper's baseline: the same of single images", FEATURES, 1, _smal, _PENALTY, any_length=False
        ),
        "seqslam": Method(
            "Milford and Wyeth 2012", FeatureSettings.of(("thumbnail",)), 10, _seqslam, any_features=False
        ),
        "nearest": Method("largest sum of products along the sequence, at equal speeds", FEATURES, 10, _nearest),
        "paper": Method(
            "Eq. 7 as published, with colour and HOG: sequences without order, cut at fixed phases",
            FeatureSettings(), 10, _paper, LAMBDA_SCALE,
        ),
    }
)  # fmt: skip

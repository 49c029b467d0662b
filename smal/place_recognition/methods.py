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
from smal.place_recognition.traverse_matching import RELATIVE_PENALTY, match_traverses

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


#: (references (n, m), queries (q, m), settings, progress) -> matches; raw features of `extract`, whole windows of both.
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
    way : callable
        See `Match`.
    penalty : float, optional
        Weight of its regularization unless told otherwise; None if it has none.
    any_features, any_length : bool
        Whether it works with other features, or another length, than its own.
    """

    meaning: str
    features: FeatureSettings
    length: int
    way: Match
    penalty: float | None = None
    any_features: bool = True
    any_length: bool = True

    def match(self, references: Features, queries: Features, settings: MatchSettings, progress: Progress) -> Matches:
        """Match raw features (n, m) and (q, m); of fewer than `length` of either it finds no match."""
        # A traverse without frames has no mean to be centred by.
        if min(len(references), len(queries)) < settings.length:
            progress(len(queries))
            return Matches.none(len(queries))
        return self.way(references, queries, settings, progress)


def _smal(references: Features, queries: Features, settings: MatchSettings, progress: Progress) -> Matches:
    penalty = RELATIVE_PENALTY if settings.penalty is None else settings.penalty
    centred = centre_traverses(references, queries, settings.features)
    return match_traverses(*centred, settings.length, penalty, progress)


def _nearest(references: Features, queries: Features, settings: MatchSettings, progress: Progress) -> Matches:
    centred = centre_traverses(references, queries, settings.features)
    return match_nearest_sequence(*centred, settings.length, progress)


def _seqslam(references: Features, queries: Features, settings: MatchSettings, progress: Progress) -> Matches:
    return match_seqslam(references, queries, SeqSlamSettings(length=settings.length), progress)


def _paper(references: Features, queries: Features, settings: MatchSettings, progress: Progress) -> Matches:
    mean = Centering.fit(references, settings.features)
    scale = LAMBDA_SCALE if settings.penalty is None else settings.penalty
    return match_as_in_the_paper(mean.apply(references), mean.apply(queries), settings.length, scale, progress)


#: What looks at the whole image, and changes little where light and season do.
FEATURES = FeatureSettings.of(("color", "hog", "gist", "thumbnail"))

METHODS: Mapping[str, Method] = MappingProxyType(
    {
        "smal": Method(
            "the paper's sparse convex matching, with sequences in order and at speeds from half to twice",
            FEATURES, 10, _smal, RELATIVE_PENALTY,
        ),
        "image": Method(
            "the paper's baseline: the same of single images", FEATURES, 1, _smal, RELATIVE_PENALTY, any_length=False
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

"""Percept: the input of a robot from one frame."""

from typing import NamedTuple

from smal.arrays import Float32s, Uint8s, Uint16s
from smal.features.detectors import Detection
from smal.features.extraction import detect, extract, looked_at
from smal.features.resizing import small
from smal.features.settings import FeatureSettings

Picture = Uint8s


class Percept(NamedTuple):
    """Features, small picture and detections of one frame."""

    #: (m,) features, as of `extract`.
    features: Float32s
    #: The small picture, as of `small`; None if missing.
    picture: Picture | None
    #: Detections by the detectors among the features.
    detected: tuple[Detection, ...]


def perceive(image: Picture, settings: FeatureSettings, depth_mm: Uint16s | None = None) -> Percept:
    """Return the percept of an image (height, width, 3), RGB; errors are as in `extract`."""
    seen = looked_at(image, settings)
    features = extract(seen, settings, depth_mm)
    return Percept(features, small(seen), tuple(detect(image, settings)))

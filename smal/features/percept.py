"""What a robot goes by of one frame: its features, a small picture, and what detectors find."""

from typing import NamedTuple

from smal.arrays import Float32s, Uint8s, Uint16s
from smal.features.detectors import Detection
from smal.features.extraction import detect, extract
from smal.features.resizing import small
from smal.features.settings import FeatureSettings

Picture = Uint8s


class Percept(NamedTuple):
    """What a robot goes by of one frame."""

    features: Float32s  # (m,), as of `extract`.
    picture: Picture | None  # The frame made small, as of `small`; None if nobody made it.
    detected: tuple[Detection, ...]  # What the detectors among the features find.


def perceive(image: Picture, settings: FeatureSettings, depth_mm: Uint16s | None = None) -> Percept:
    """Return what a robot goes by of an image (height, width, 3), RGB; errors are as of `extract`."""
    return Percept(extract(image, settings, depth_mm), small(image), tuple(detect(image, settings)))

"""Multimodal features of one camera frame: one modality a file, concatenated by `extract`."""

from smal.features.centering import Centering, FeaturesError
from smal.features.extraction import extract
from smal.features.modalities import MODALITIES, MODALITY_NAMES, modality_named
from smal.features.modality import Modality
from smal.features.settings import FeatureSettings, select

__all__ = [
    "MODALITIES",
    "MODALITY_NAMES",
    "Centering",
    "FeatureSettings",
    "FeaturesError",
    "Modality",
    "extract",
    "modality_named",
    "select",
]

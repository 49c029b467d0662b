"""Multimodal features of one camera frame: one modality a file, concatenated by `extract`."""

from smal.features.centering import Centering
from smal.features.extraction import extract
from smal.features.settings import MODALITIES, FeatureSettings

__all__ = ["MODALITIES", "Centering", "FeatureSettings", "extract"]

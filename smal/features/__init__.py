"""Multimodal features of one camera frame: one modality a file, concatenated by `extract`."""

from smal.features.centering import Centering
from smal.features.extraction import extract
from smal.features.modality import Modality
from smal.features.selection import select, settings_of
from smal.features.settings import MODALITIES, FeatureSettings

__all__ = ["MODALITIES", "Centering", "FeatureSettings", "Modality", "extract", "select", "settings_of"]

"""Settings of the features service."""

from __future__ import annotations

from pydantic import field_validator

from services.kit.settings import ServiceSettings
from smal.features import FeatureSettings


class FeaturesSettings(ServiceSettings):
    """Which features to make."""

    modalities: str = ",".join(FeatureSettings().modalities)
    """Feature modalities, separated by commas, in their order in the observation."""

    @field_validator("modalities")
    @classmethod
    def _known(cls, value: str) -> str:
        FeatureSettings.parse(value)
        return value

    @property
    def features(self) -> FeatureSettings:
        """The modalities as settings of the library."""
        return FeatureSettings.parse(self.modalities)

"""Settings of the features service."""

from __future__ import annotations

from services.settings import ServiceSettings


class FeaturesSettings(ServiceSettings):
    """The modalities are those of ``smal.features``; they have no settings of their own yet."""

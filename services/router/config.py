"""Settings of the router."""

from __future__ import annotations

from services.kit.settings import ServiceSettings


class RouterSettings(ServiceSettings):
    """Listens on ``--router``."""

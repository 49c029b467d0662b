"""Settings of the router."""

from __future__ import annotations

from services.process import ServiceSettings


class RouterSettings(ServiceSettings):
    """Listens on ``--router``."""

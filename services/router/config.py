"""Settings of the router."""

from __future__ import annotations

from services.kit.settings import ServiceSettings


class RouterSettings(ServiceSettings):
    """Listens on ``--router``."""

    insecure: bool = False
    """Whether it may listen without certificates where other machines reach it."""

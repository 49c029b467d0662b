"""Settings that every service has."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field
from pydantic_settings import BaseSettings, SettingsConfigDict

from schemas.base import ROBOT_ID_PATTERN
from services.kit.bus import DEFAULT_ROUTER


class ServiceSettings(BaseSettings):
    """Settings that every service has; each can be given as ``SMAL_<NAME>`` or ``--<name>``."""

    model_config = SettingsConfigDict(env_prefix="SMAL_", cli_kebab_case=True, use_attribute_docstrings=True)

    robot: Annotated[str, Field(pattern=ROBOT_ID_PATTERN)] = "rescuebot"
    """Robot id, part of every topic's key."""
    router: str = DEFAULT_ROUTER
    """Address of the Zenoh router."""
    http: Annotated[str | None, Field(pattern=r"^[^\s/:]*:\d{1,5}$")] = None
    """Where to answer GET /healthz and GET /metrics, HOST:PORT; nowhere if not given."""
    log_level: Literal["debug", "info", "warning", "error"] = "info"
    """Least severe messages that are logged."""

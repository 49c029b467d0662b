"""Settings of the policy service."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from pydantic import Field

from services.process import ServiceSettings


class PolicySettings(ServiceSettings):
    """The model to start with; another is loaded by the queryable ``load``."""

    model: Path | None = None
    """Model file, made by `smal learn`."""
    stride: Annotated[int | None, Field(ge=1, le=1000)] = None
    """Frames from one decision to the next; the model's own if not given."""

"""Settings of the recorder."""

from __future__ import annotations

from pathlib import Path

from services.kit.settings import ServiceSettings


class RecorderSettings(ServiceSettings):
    """Where to record."""

    recordings: Path | None = None
    """Folder to record every episode in from the start; without it, recording waits for the call ``start``."""

"""Settings of the recorder."""

from __future__ import annotations

from pathlib import Path

from services.kit.root import RootSettings


class RecorderSettings(RootSettings):
    """Where to record."""

    recordings: Path | None = None
    """Folder, wherever it is, to record every episode in from the start; without it, recording waits for the call
    ``start``, which names one below the root."""

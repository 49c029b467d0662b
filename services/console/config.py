"""Settings of the console."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from pydantic import Field

from services.kit.root import RootSettings


class ConsoleSettings(RootSettings):
    """Where the page is, and who may open it."""

    console: Annotated[str, Field(pattern=r"^[^\s/:]+:\d{1,5}$")] = "127.0.0.1:8080"
    """Where the page is, HOST:PORT; a host that other machines reach needs the three settings that follow."""
    console_cert: Path | None = None
    """Certificate of the page's host, with those that sign it; browsers have to know their authority."""
    console_key: Path | None = None
    """Its key."""
    console_token: Path | None = None
    """File with the word, 16 letters or more, that whoever opens the page has to know: https://HOST:PORT/?token=WORD."""
    insecure: bool = False
    """Listen where other machines reach it, and let everybody in: where something else sees to that, as in a container
    whose port is this machine's."""

"""Drive by keyboard: ``python -m services.teleop``, the same as ``smal teleop``."""

from __future__ import annotations

import sys

from services.kit.process import EXIT_USAGE, read_settings, run_service
from services.teleop.config import TeleopSettings
from services.teleop.session import run
from services.teleop.terminal import NoTerminalError, require_terminal


def serve() -> None:
    """Drive until the operator quits."""
    settings = read_settings(TeleopSettings, "teleop")
    try:
        require_terminal()
    except NoTerminalError as error:
        sys.stderr.write(f"teleop: {error}\n")
        raise SystemExit(EXIT_USAGE) from None
    run(settings)


if __name__ == "__main__":
    run_service("teleop", serve)

"""Drive by keyboard: ``python -m services.teleop``, the same as ``smal teleop``."""

from services.kit.process import read_settings, run_service
from services.teleop.session import TeleopSettings, run
from services.teleop.terminal import require_terminal


def serve() -> None:
    """Drive until the operator quits."""
    settings = read_settings(TeleopSettings, "teleop")
    require_terminal()
    run(settings)


if __name__ == "__main__":
    run_service("teleop", serve)

"""Run the console: ``python -m services.console --console 127.0.0.1:8080``."""

from __future__ import annotations

from services.console.config import ConsoleSettings
from services.console.newest_content import Board
from services.console.server import WebServer
from services.console.service import ConsoleService
from services.kit.node import Node
from services.kit.process import configure_logging, read_settings, run_service


def serve() -> None:
    """Serve the page until stopped."""
    settings = read_settings(ConsoleSettings, "console")
    configure_logging(settings.log_level)
    with Node("console", settings) as node:
        node.stop_on_signals()
        board = Board()
        service = ConsoleService(node, board, settings.root)
        server = WebServer(service, board, settings)
        # Where it listens on every address, this one leads there from this machine.
        node.log.info("the page is at %s", server.address.replace("//0.0.0.0:", "//127.0.0.1:"))
        try:
            node.spin()
        finally:
            server.close()
            service.close()


if __name__ == "__main__":
    run_service("console", serve)

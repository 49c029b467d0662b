"""Run the console: ``python -m services.console --console 127.0.0.1:8080``."""

from services.console.config import ConsoleSettings
from services.console.newest_content import Board
from services.console.server import WebServer
from services.console.service import ConsoleService
from services.kit.node import Node
from services.kit.process import run_node


def serve(node: Node, settings: ConsoleSettings) -> None:
    """Serve the console until stopped."""
    board = Board()
    service = ConsoleService(node, board, settings.root)
    server = WebServer(service, board, settings)
    # A console that listens on all addresses is reachable here through the loopback address.
    node.log.info(
        "page of %s at %s", node.robot, server.address.replace("//0.0.0.0:", "//127.0.0.1:")
    )
    try:
        node.spin()
    finally:
        server.close()
        service.close()


if __name__ == "__main__":
    run_node("console", ConsoleSettings, serve)

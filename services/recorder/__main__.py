"""Run the recorder: ``python -m services.recorder --recordings drives``."""

from services.kit.node import Node
from services.kit.process import run_node
from services.recorder.service import RecorderService, RecorderSettings


def serve(node: Node, settings: RecorderSettings) -> None:
    """Record until stopped, then complete every file."""
    recorder = RecorderService(node, settings.root, settings.recordings)
    try:
        node.spin()
        node.drain()
    finally:
        recorder.close()


if __name__ == "__main__":
    run_node("recorder", RecorderSettings, serve)

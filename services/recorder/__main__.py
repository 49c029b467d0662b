"""Run the recorder: ``python -m services.recorder --recordings drives``."""

from __future__ import annotations

from services.kit.node import Node
from services.kit.process import configure_logging, read_settings, run_service
from services.recorder.config import RecorderSettings
from services.recorder.service import RecorderService


def serve() -> None:
    """Record until stopped; then finish every file."""
    settings = read_settings(RecorderSettings, "recorder")
    configure_logging(settings.log_level)
    with Node("recorder", settings) as node:
        node.stop_on_signals()
        recorder = RecorderService(node, settings.root, settings.recordings)
        try:
            node.spin()
            node.drain()
        finally:
            recorder.close()


if __name__ == "__main__":
    run_service("recorder", serve)

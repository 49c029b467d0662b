"""Run the tracker: ``python -m services.tracker``."""

from __future__ import annotations

from schemas import topics
from services.kit.node import Node
from services.kit.process import configure_logging, read_settings, run_service
from services.tracker.config import TrackerSettings
from services.tracker.service import TrackerService
from services.tracker.tag_tracking import Tag


def serve() -> None:
    """Turn overhead images into tracked poses until stopped."""
    settings = read_settings(TrackerSettings, "tracker")
    configure_logging(settings.log_level)
    tracker = TrackerService(Tag(settings.tag_number, settings.tag_side_m, settings.tag_height_m))
    with Node("tracker", settings) as node:
        node.stop_on_signals()
        node.detail = tracker.detail
        node.subscribe(topics.OVERHEAD, tracker.handle)
        node.log.info("tracking tag %d of %g m", settings.tag_number, settings.tag_side_m)
        node.spin()


if __name__ == "__main__":
    run_service("tracker", serve)

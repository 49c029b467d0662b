"""Run the tracker: ``python -m services.tracker``."""

from schemas import topics
from services.kit.node import Node
from services.kit.process import run_group
from services.tracker.service import TrackerService, TrackerSettings
from services.tracker.tag_tracking import Tag


def serve(node: Node, settings: TrackerSettings) -> None:
    """Publish tracked poses of overhead images until stopped."""
    tracker = TrackerService(Tag(settings.tag_number, settings.tag_side_m, settings.tag_height_m))
    node.detail = tracker.detail
    node.subscribe(topics.OVERHEAD, tracker.handle)
    node.log.info("tracking tag %d of %g m", settings.tag_number, settings.tag_side_m)
    node.spin()


if __name__ == "__main__":
    run_group("tracker", TrackerSettings, serve)

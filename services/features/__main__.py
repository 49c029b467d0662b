"""Run the features service: ``python -m services.features --modalities color,hog``."""

from __future__ import annotations

from schemas import topics
from services.features.config import FeaturesSettings
from services.features.service import FeaturesService
from services.kit.node import Node
from services.kit.process import configure_logging, read_settings, run_service


def serve() -> None:
    """Turn frames into observations until stopped."""
    settings = read_settings(FeaturesSettings, "features")
    configure_logging(settings.log_level)
    service = FeaturesService(settings.features)
    with Node("features", settings) as node:
        node.stop_on_signals()
        node.detail = service.detail
        if service.needs_depth:
            # Two, so that the depth image of a frame that waits does not give way to that of the next.
            node.subscribe(topics.DEPTH, service.handle_depth, depth=2)
        node.subscribe(topics.JPEG, service.handle, depth=1)
        node.log.info("extracting %s", ", ".join(settings.features.modalities))
        node.spin()


if __name__ == "__main__":
    run_service("features", serve)

"""Run the features service: ``python -m services.features``."""

from __future__ import annotations

from schemas import topics
from services.features.config import FeaturesSettings
from services.features.service import FeaturesService
from services.process import Node, configure_logging, read_settings, run_service
from smal.features import FeatureSettings


def serve() -> None:
    """Turn frames into observations until stopped."""
    settings = read_settings(FeaturesSettings, "features")
    configure_logging(settings.log_level)
    features = FeatureSettings()
    with Node("features", settings) as node:
        node.stop_on_signals()
        node.detail = lambda: {"modalities": " ".join(features.modalities), "fingerprint": features.fingerprint}
        node.subscribe(topics.CAMERA, FeaturesService(features).handle)
        node.log.info("extracting %s", ", ".join(features.modalities))
        node.spin()


if __name__ == "__main__":
    run_service("features", serve)

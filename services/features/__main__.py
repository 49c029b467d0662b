"""Run the features service: ``python -m services.features --modalities color,hog``."""

from schemas import topics
from services.features.service import FeaturesService, FeaturesSettings
from services.kit.node import Node
from services.kit.process import run_group


def serve(node: Node, settings: FeaturesSettings) -> None:
    """Compute observations of frames until stopped."""
    service = FeaturesService(settings.features)
    node.detail = service.detail
    node.subscribe(topics.JPEG, service.handle, depth=1)
    node.log.info("extracting %s", settings.modalities)
    node.spin()


if __name__ == "__main__":
    run_group("features", FeaturesSettings, serve)

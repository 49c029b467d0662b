"""Run the recognition service: ``python -m services.recognition --model campus.smal``."""

from schemas import topics
from services.kit.model_service import ModelSettings, serve_model
from services.kit.node import Node
from services.kit.process import run_group
from services.recognition.service import RecognitionService


class RecognitionSettings(ModelSettings):
    """Settings of recognition."""

    watch: bool = False
    """Detect unexpected ground, for a robot without a depth camera to stop before."""


def serve(node: Node, settings: RecognitionSettings) -> None:
    """Publish states until stopped."""
    service = RecognitionService(settings.watch)
    service.behind = lambda: node.waits(topics.OBSERVATION)
    service.announce = node.publish
    service.warn = node.log.warning
    node.subscribe(topics.ODOMETRY, service.see)
    node.subscribe(topics.APPLIED, service.see_applied)
    serve_model(node, settings, service, topics.OBSERVATION)


if __name__ == "__main__":
    run_group("recognition", RecognitionSettings, serve)

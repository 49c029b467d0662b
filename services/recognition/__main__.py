"""Run the recognition service: ``python -m services.recognition --model campus.smal``."""

from __future__ import annotations

from schemas import topics
from services.kit.model_service import serve_model
from services.kit.node import Node
from services.kit.process import run_service
from services.recognition.service import RecognitionService


def serve() -> None:
    """Recognize states until stopped."""
    service = RecognitionService()

    def wire(node: Node) -> None:
        service.behind = lambda: node.waits(topics.OBSERVATION)
        service.announce = node.publish
        node.subscribe(topics.ODOMETRY, service.see)
        node.subscribe(topics.APPLIED, service.see_applied)

    serve_model("recognition", service, topics.OBSERVATION, wire)


if __name__ == "__main__":
    run_service("recognition", serve)

"""Run the recognition service: ``python -m services.recognition --model campus.smal``."""

from __future__ import annotations

from schemas import topics
from schemas.rpc import LoadRequest
from services.process import Node, configure_logging, read_settings, run_service
from services.recognition.config import RecognitionSettings
from services.recognition.service import RecognitionService


def serve() -> None:
    """Recognise states until stopped."""
    settings = read_settings(RecognitionSettings, "recognition")
    configure_logging(settings.log_level)
    service = RecognitionService()
    if settings.model is not None:
        service.load(LoadRequest(path=str(settings.model), stride=settings.stride))
    with Node("recognition", settings) as node:
        node.stop_on_signals()
        node.detail = service.detail
        node.serve("load", LoadRequest, service.load)
        node.subscribe(topics.OBSERVATION, service.handle)
        node.log.info("model %s", settings.model or "not loaded yet; waiting for rpc/recognition/load")
        node.spin()


if __name__ == "__main__":
    run_service("recognition", serve)

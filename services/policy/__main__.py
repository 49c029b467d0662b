"""Run the policy service: ``python -m services.policy --model campus.smal``."""

from __future__ import annotations

from schemas import topics
from schemas.rpc import LoadRequest
from services.policy.config import PolicySettings
from services.policy.service import PolicyService
from services.process import Node, configure_logging, read_settings, run_service


def serve() -> None:
    """Decide until stopped."""
    settings = read_settings(PolicySettings, "policy")
    configure_logging(settings.log_level)
    service = PolicyService()
    if settings.model is not None:
        service.load(LoadRequest(path=str(settings.model), stride=settings.stride))
    with Node("policy", settings) as node:
        node.stop_on_signals()
        node.detail = service.detail
        node.serve("load", LoadRequest, service.load)
        node.subscribe(topics.STATE, service.handle)
        node.log.info("model %s", settings.model or "not loaded yet; waiting for rpc/policy/load")
        node.spin()


if __name__ == "__main__":
    run_service("policy", serve)

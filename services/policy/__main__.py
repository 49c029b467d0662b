"""Run the policy service: ``python -m services.policy --model campus.smal``."""

from __future__ import annotations

from schemas import topics
from services.kit.model_service import serve_model
from services.kit.node import Node
from services.kit.process import run_service
from services.policy.service import PolicyService


def serve() -> None:
    """Decide until stopped."""
    service = PolicyService()

    def wire(node: Node) -> None:
        node.subscribe(topics.APPLIED, service.see_applied)

    serve_model("policy", service, topics.STATE, wire)


if __name__ == "__main__":
    run_service("policy", serve)

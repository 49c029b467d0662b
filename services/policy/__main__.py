"""Run the policy service: ``python -m services.policy --model campus.smal``."""

from schemas import topics
from services.kit.model_service import ModelSettings, serve_model
from services.kit.node import Node
from services.kit.process import run_group
from services.policy.service import PolicyService


def serve(node: Node, settings: ModelSettings) -> None:
    """Publish decisions and commands until stopped."""
    service = PolicyService()
    node.subscribe(topics.APPLIED, service.see_applied)
    node.subscribe(topics.ODOMETRY, service.obstacles.store_odometry)
    node.subscribe(topics.DEPTH, service.obstacles.store_depth)
    serve_model(node, settings, service, topics.STATE)


if __name__ == "__main__":
    run_group("policy", ModelSettings, serve)

"""Run the policy service: ``python -m services.policy --model campus.smal``."""

from __future__ import annotations

from schemas import topics
from services.kit.model_service import serve_model
from services.kit.node import run_service
from services.policy.service import PolicyService

if __name__ == "__main__":
    run_service("policy", lambda: serve_model("policy", PolicyService(), topics.STATE))

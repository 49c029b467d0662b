"""Run the recognition service: ``python -m services.recognition --model campus.smal``."""

from __future__ import annotations

from schemas import topics
from services.model_service import serve_model
from services.process import run_service
from services.recognition.service import RecognitionService

if __name__ == "__main__":
    run_service("recognition", lambda: serve_model("recognition", RecognitionService(), topics.OBSERVATION))

"""``smal topic latency`` as an operator runs it, against a real router."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from itertools import count
from typing import Any

import pytest

from schemas.base import Message
from schemas.command import Command, CommandApplied
from schemas.compressed_image import CompressedImage
from schemas.observation import Observation
from schemas.pose import Pose
from schemas.state import State
from schemas.topics import APPLIED, COMMANDS
from services.cli.listening import commands
from services.kit.bus import Bus
from tests.schemas.messages import EXAMPLES
from tests.services.cli.conftest import Smal
from tests.services.waiting import eventually, send_as_stranger

Measured = Callable[..., tuple[int, str, str]]
CHAIN: tuple[type[Message], ...] = (Pose, CompressedImage, Observation, State, Command, CommandApplied)


@pytest.fixture
def measured(smal: Smal, client: Bus, router_endpoint: str, monkeypatch: pytest.MonkeyPatch) -> Iterator[Measured]:
    """Run the command while a stack that the policy drives talks, a message a call, until several ticks were heard."""
    witness = Bus("rescuebot", router_endpoint)

    def wait(_what: str, _seconds: float) -> None:
        # The router passes subscriptions on in the background, this later one after those of the command.
        heard: list[bytes] = []
        witness.subscribe(APPLIED, lambda payload, *_: heard.append(payload))
        chain = ((tick, cls) for tick in count() for cls in CHAIN)

        def enough() -> bool:
            tick, cls = next(chain)
            changes: dict[str, Any] = {"tick": tick}
            if cls in (Command, CommandApplied):
                changes |= {"source": "policy"}
            if cls is CommandApplied:
                changes |= {"answered_tick": tick, "latency_ns": 12_000_000}
            client.publish(EXAMPLES[cls].model_copy(update=changes))
            send_as_stranger(client, COMMANDS["teleop"], b"\xc1")
            return len(heard) >= 20

        eventually(enough)

    monkeypatch.setattr(commands, "wait", wait)
    yield lambda *arguments: smal("topic", "latency", *arguments, "--router", router_endpoint)
    witness.close()


def hops(rows: list[dict[str, Any]]) -> list[tuple[str, str]]:
    return [(row["from"], row["to"]) for row in rows]


def test_from_frame_to_command(measured: Measured) -> None:
    status, out, err = measured("--json", "--camera")
    assert status == 0
    found = json.loads(out)
    assert found["frame"] == "camera/jpeg"
    assert found["frames"] >= 5
    every = found["drivers"]["policy"]["all"]
    assert hops(every) == [
        ("frame", "observation"),
        ("observation", "state"),
        ("state", "command/policy"),
        ("frame", "command/policy"),
        ("command/policy", "command/applied"),
        ("frame", "accepted"),
    ]
    assert all(row["ticks"] >= 5 and row["p50_ms"] <= row["p95_ms"] <= row["max_ms"] for row in every)
    assert every[3]["p50_ms"] > 0
    assert every[-1]["p50_ms"] == pytest.approx(12.0)
    assert "messages could not be decoded; see smal topic echo" in err

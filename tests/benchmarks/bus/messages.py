"""The messages that the benchmark of the bus sends, each built from raw parts as its service does."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np

from schemas import topics
from schemas.array import Float32Array
from schemas.base import Message
from schemas.command import Command, CommandApplied
from schemas.image import Image
from schemas.observation import Observation
from schemas.state import Place, State
from schemas.topics import Topic
from smal.features import FeatureSettings
from smal.settings import SETTINGS

#: How much longer than plain Zenoh a message may take.
FRAME_LIMIT: Final = 1.3
SMALL_LIMIT: Final = 3.0
_SIZE: Final = (768, 1024, 3)
_MODEL: Final = "0123456789abcdef"

_rng = np.random.default_rng(1)
_PIXELS: Final = _rng.integers(0, 256, _SIZE, dtype=np.uint8)
_FEATURES: Final = _rng.standard_normal(FeatureSettings().size, dtype=np.float32)


@dataclass(frozen=True)
class Case:
    """One message of the wire.

    Attributes
    ----------
    name
        For the reader.
    topic
        Where it is sent.
    limit
        Of its time over that of plain Zenoh.
    build
        Makes it from raw parts; the argument is what it descends from.
    """

    name: str
    topic: Topic
    limit: float
    build: Callable[[Message], Message]


def _frame(cause: Message) -> Message:
    height, width, _ = _SIZE
    return Image.after(cause, width=width, height=height, data=_PIXELS.tobytes())


def _observation(cause: Message) -> Message:
    return Observation.after(cause, fingerprint=_MODEL, features=Float32Array.from_numpy(_FEATURES))


def _state(cause: Message) -> Message:
    places = tuple(
        Place(keyframe=k, ahead_m=0.1 * k, left_m=-0.1, turned_rad=0.05, weight=1.0 / SETTINGS.places)
        for k in range(SETTINGS.places)
    )
    return State.after(
        cause, status="recognized", model=_MODEL, places=places, lost=0.01, cosine=0.7, tracked_m=12.5
    )  # fmt: skip


def _command(cause: Message) -> Message:
    return Command.after(cause, source="policy", atom="forward")


def _applied(cause: Message) -> Message:
    return CommandApplied.after(
        cause, sequence=1, atom="forward", speed=1.0, source="policy", reason="command", answered_tick=cause.tick,
        latency_ns=40_000_000,
    )  # fmt: skip


CASES: Final = (
    Case("frame 1024x768", topics.CAMERA, FRAME_LIMIT, _frame),
    Case("observation", topics.OBSERVATION, SMALL_LIMIT, _observation),
    Case(f"state, {SETTINGS.places} places", topics.STATE, SMALL_LIMIT, _state),
    Case("command", topics.COMMANDS["policy"], SMALL_LIMIT, _command),
    Case("command applied", topics.APPLIED, SMALL_LIMIT, _applied),
)

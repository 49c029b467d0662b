"""That a person, or a program that has episodes run, is still there."""

from __future__ import annotations

from typing import Annotated, ClassVar

from pydantic import Field

from schemas.base import Message, SessionId


class Heartbeat(Message):
    """Sign of life of whoever is responsible for what the robot does."""

    topic: ClassVar[str] = "heartbeat"
    max_bytes: ClassVar[int] = 1024

    session: SessionId
    """The process that sends."""
    sequence: Annotated[int, Field(ge=0, lt=2**63)]
    """Order of what one process sends, from 0."""
    operator: bool
    """Whether a person sits there: when the robot no longer hears of the operator, it stands."""
    present: bool = True
    """False says good-bye; whoever leaves so is not missed."""

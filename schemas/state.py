"""Which learned state the robot is in (Eq. 9 of the paper)."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal, Self

from pydantic import Field, model_validator

from schemas.base import Message


class State(Message):
    """Answer of recognition for one frame; only ``recognized`` and ``unknown`` call for a decision."""

    topic: ClassVar[str] = "state"

    status: Literal["idle", "collecting", "recognized", "unknown"]
    """idle: no model; collecting: no decision is due at this frame; unknown: no learned state matches."""
    state: Annotated[int | None, Field(ge=0, le=1_000_000)] = None
    """Index of the learned state, when recognized."""
    position: Annotated[float, Field(ge=-1e6, le=1e6)] = 0.0
    """Where in the matched template sequence the last frame stands, in frames from its first; may lie outside it."""
    score: Annotated[float, Field(ge=0, le=1e9)] = 0.0
    """Weight of the matched sequence over the sequence length (Eq. 9 divided by l)."""
    total_weight: Annotated[float, Field(ge=0, le=1e9)] = 0.0
    """Weight of all sequences over the sequence length."""
    residual: Annotated[float, Field(ge=0, le=1e9)] = 0.0
    """Mean length of what the templates leave unexplained of a query frame; a frame has length 1."""
    duality_gap: Annotated[float, Field(ge=0, le=1e9)] = 0.0
    """Certificate of the weights: relative distance to the global optimum of Eq. 7 at most."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if (self.status == "recognized") != (self.state is not None):
            raise ValueError("state is given exactly when the status is 'recognized'")
        return self

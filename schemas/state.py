"""Which learned state the robot is in (Eq. 9 of the paper)."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal, Self

from pydantic import Field, model_validator

from schemas.base import Message, Strict

MAX_CANDIDATES = 64


class Candidate(Strict):
    """A learned state that the last frames may show."""

    state: Annotated[int, Field(ge=0, le=1_000_000)]
    """Its index."""
    phase: Annotated[float, Field(ge=-1e6, le=1e6)]
    """Frame of its template sequence, from 0, at which the last frame is; may lie beyond its ends."""
    weight: Annotated[float, Field(ge=0, le=1.001)]
    """Its share of the belief."""


class State(Message):
    """Answer of recognition for one frame; only ``recognized`` and ``unknown`` call for a decision."""

    version: ClassVar[int] = 3
    topic: ClassVar[str] = "state"

    status: Literal["idle", "collecting", "recognized", "unknown"]
    """idle: no model; collecting: no decision is due at this frame; unknown: no learned state matches."""
    model: Annotated[str | None, Field(pattern=r"^[0-9a-f]{8,64}$")] = None
    """Beginning of the checksum of the model that the state belongs to; a policy refuses another's. None when idle."""
    state: Annotated[int | None, Field(ge=0, le=1_000_000)] = None
    """Index of the learned state, when recognized."""
    phase: Annotated[float | None, Field(ge=-1e6, le=1e6)] = None
    """Frame of the matched template sequence, from 0, at which the last frame is; may lie beyond its ends."""
    score: Annotated[float, Field(ge=0, le=1e9)] = 0.0
    """Weight of the matched sequence over the sequence length (Eq. 9 divided by l)."""
    total_weight: Annotated[float, Field(ge=0, le=1e9)] = 0.0
    """Weight of all sequences over the sequence length."""
    residual: Annotated[float, Field(ge=0, le=1)] = 1.0
    """Share of the query that the templates leave unexplained, 0 to 1."""
    agreement: Annotated[float, Field(ge=-1.01, le=1.01)] = 0.0
    """Mean cosine between the query frames and the nearest frames of the matched sequence."""
    duality_gap: Annotated[float, Field(ge=0, le=1e9)] = 0.0
    """Certificate of the weights: relative distance to the global optimum of Eq. 7 at most."""
    candidates: Annotated[tuple[Candidate, ...], Field(max_length=MAX_CANDIDATES)] = ()
    """The belief over states, heaviest first; empty unless recognized."""
    explained: Annotated[float, Field(ge=0, le=1)] = 1.0
    """How much templates explain of the last frames, recent ones counting more: 1 all, 0 no more than of what is new.
    1 too where that is not known: in the paper's scheme, and unless recognized."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if (self.model is None) != (self.status == "idle"):
            raise ValueError("the model is given exactly when the status is not 'idle'")
        recognized = self.status == "recognized"
        if (self.state is not None, self.phase is not None) != (recognized, recognized):
            raise ValueError("state and phase are given exactly when the status is 'recognized'")
        return self

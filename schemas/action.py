"""What the policy decided."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

from pydantic import Field

from schemas.base import Atom, Message


class Action(Message):
    """One decision: the atom movements that follow, one a frame, until the next decision replaces them."""

    topic: ClassVar[str] = "action"

    reason: Literal["policy", "look_around", "goal", "lost"]
    """policy: the learned action; look_around: state unknown, turning; lost: gave up turning; goal: end state."""
    state: Annotated[int | None, Field(ge=0, le=1_000_000)] = None
    """The recognised state, if any."""
    atoms: Annotated[tuple[Atom, ...], Field(max_length=1000)]
    """The planned atom movements, one a frame."""

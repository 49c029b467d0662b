"""What the policy decided."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

from pydantic import Field

from schemas.base import Atom, Message


class Action(Message):
    """One decision: the atom movements that follow, one a frame, until the next decision replaces them."""

    topic: ClassVar[str] = "action"
    version: ClassVar[int] = 2

    kind: Literal["action", "goal", "dead_end", "coast", "look_around", "stop"]
    """action: the policy's; goal: the rest of a demonstration that ended here; dead_end: the rest of a drive that
    stopped here without success; coast: the rest of the last plan, for a moment in which the state is unknown;
    look_around: state unknown, turning on the spot; stop: turning has not helped."""
    state: Annotated[int | None, Field(ge=0, le=1_000_000)] = None
    """The recognised state, if any."""
    atoms: Annotated[tuple[Atom, ...], Field(max_length=1000)]
    """The planned atom movements, one a frame."""

"""What the policy decided."""

from typing import Annotated, ClassVar, Literal

from pydantic import Field

from schemas.base import Atom, Message
from schemas.episode import Said

Metres = Annotated[float, Field(ge=-100, le=100)]


class Action(Message):
    """One decision: the atom movements that follow, one a frame, until the next decision replaces them."""

    topic: ClassVar[str] = "action"

    kind: Literal[
        "follow",
        "action",
        "goal",
        "dead_end",
        "look_around",
        "guess",
        "blocked",
        "stop",
        "search",
        "blind",
    ]
    """follow: along the taught way; action: the policy's, of the paper's scheme; goal: the robot says that it has
    arrived, and found its goal or that it is not here; search: it has arrived, and turns to see what is sought;
    dead_end: nothing is known to follow, and it stops, as for stop: the state is unknown, of the paper's scheme;
    look_around: turning on the spot, since it is not known where the robot is; guess: driving all the same, since that
    has not helped; blocked: it stops and waits, since something is in its way and nothing leads round; blind: it stops,
    because no view has spoken for its place for too long, or its camera shows nothing."""
    state: Annotated[int | None, Field(ge=0, le=1_000_000)] = None
    """The keyframe, or in the paper's scheme the state, where the robot is; none where it is lost."""
    atoms: Annotated[tuple[Atom, ...], Field(max_length=1000)]
    """The planned atom movements, one a frame."""
    arrived: bool = False
    """Whether the robot takes itself to be where it was taught that the goal is; of the filter."""
    says: Said | None = None
    """What it says of the goal, having nothing left to do: found, or not here; of the filter."""
    obstacles: Annotated[tuple[tuple[Metres, Metres], ...], Field(max_length=100)] = ()
    """Where something stands about the robot: metres ahead of it and to its left, some of the places."""

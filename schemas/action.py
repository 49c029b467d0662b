"""Decisions of the policy."""

from typing import Annotated, ClassVar, Literal

from pydantic import Field

from schemas.base import Atom, Message
from schemas.episode import Said

Metres = Annotated[float, Field(ge=-100, le=100)]


class Action(Message):
    """Decision: atom movements, one per frame, until the next decision replaces them."""

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
    """follow: along the taught way. action: the action of the paper's scheme. goal: the robot has
    arrived and reports that it found its goal, or that the goal is not here. search: it has
    arrived, and turns to find the target or approaches it. dead_end: no taught way continues, and
    it stops. stop: the state is unknown (paper's scheme). look_around: it turns to find its place,
    for example at the end of the way or after its wheels stalled. guess: it drives although its
    place is unknown, since turning did not help. blocked: it waits before an obstacle, turns to
    keep it in view, or backs off; it also backs off after its wheels stalled. blind: it stops
    because no view has confirmed its place for too long, or because its camera shows no texture.
    """
    state: Annotated[int | None, Field(ge=0, le=1_000_000)] = None
    """Keyframe of the robot, or its state in the paper's scheme; None if the robot is lost."""
    atoms: Annotated[tuple[Atom, ...], Field(max_length=1000)]
    """Planned atom movements, one per frame."""
    arrived: bool = False
    """Whether the robot's estimated position is at the goal (filter only)."""
    says: Said | None = None
    """Result that the robot reports at the end of its run: found, or not here (filter only)."""
    obstacles: Annotated[tuple[tuple[Metres, Metres], ...], Field(max_length=100)] = ()
    """Positions of some obstacles around the robot: metres ahead and to the left."""

"""Judges of a reached goal: the robot's task, or otherwise the operator."""

from typing import Protocol, TypeVar

from services.robot.body import View

V_contra = TypeVar("V_contra", bound=View, contravariant=True)


class Task(Protocol[V_contra]):
    """Task of the robot."""

    def reached(self, view: V_contra, goal: str) -> bool:
        """Return whether a frame shows that a goal is reached."""

    def gone(self, view: V_contra, goal: str) -> bool | None:
        """Return whether a goal is absent; None if unknown."""

    def told(self, view: V_contra, goal: str) -> None:
        """Store the operator's confirmation that a frame shows a goal."""


class OperatorsTask:
    """Task whose goal only the operator can confirm."""

    def reached(self, view: View, goal: str) -> bool:
        """Return False: frames are not evaluated."""
        return False

    def gone(self, view: View, goal: str) -> bool | None:
        """Return None: frames are not evaluated."""
        return None

    def told(self, view: View, goal: str) -> None:
        """Ignore the confirmation."""

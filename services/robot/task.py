"""Judges of a reached goal: the robot's task, or otherwise the operator."""

from typing import Protocol, TypeVar

from services.robot.body import View

V_contra = TypeVar("V_contra", bound=View, contravariant=True)


class Task(Protocol[V_contra]):
    """Task of the robot; by default it does not detect absent goals, and ignores confirmations."""

    def reached(self, view: V_contra, goal: str) -> bool:
        """Return whether a frame shows that a goal is reached."""

    def gone(self, view: V_contra, goal: str) -> bool | None:
        """Return whether a goal is absent; None if unknown."""
        return None

    def told(self, view: V_contra, goal: str) -> None:
        """Handle the operator's confirmation that a frame shows a goal."""
        return


class OperatorsTask(Task[View]):
    """Task whose goal only the operator can confirm."""

    def reached(self, view: View, goal: str) -> bool:
        """Return False: frames are not evaluated."""
        return False

"""Who says that a goal is reached: the robot's task, where there is one; else only the operator can."""

from typing import Protocol, TypeVar

from services.robot.body import View

V_contra = TypeVar("V_contra", bound=View, contravariant=True)


class Task(Protocol[V_contra]):
    """What the robot is there for."""

    def reached(self, view: V_contra, goal: str) -> bool:
        """Return whether a frame shows that a goal is reached."""

    def gone(self, view: V_contra, goal: str) -> bool | None:
        """Return whether a goal is nowhere; None where nobody knows."""

    def told(self, view: V_contra, goal: str) -> None:
        """Take from the operator that a frame shows a goal."""


class OperatorsTask:
    """The goal is where the operator says that it is."""

    def reached(self, view: View, goal: str) -> bool:
        """Return False: nothing in a frame tells."""
        return False

    def gone(self, view: View, goal: str) -> bool | None:
        """Return None: nothing in a frame tells."""
        return None

    def told(self, view: View, goal: str) -> None:
        """Do nothing: what the operator says next counts again."""

"""Who says that a goal is reached: the robot's task, where there is one; else only the operator can."""

from typing import Protocol, TypeVar

from services.robot.body import View

V_contra = TypeVar("V_contra", bound=View, contravariant=True)


class Task(Protocol[V_contra]):
    """What the robot is there for."""

    def reached(self, view: V_contra) -> bool:
        """Return whether a frame shows that the goal is reached."""


class OperatorsTask:
    """The goal is where the operator says that it is."""

    def reached(self, view: View) -> bool:
        """Return False: nothing in a frame tells."""
        return False

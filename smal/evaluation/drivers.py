"""SMAL and the paper's scheme as drivers of `smal.evaluation.driver`."""

from collections.abc import Sequence
from pathlib import Path
from typing import Final

from smal.arrays import Uint8s
from smal.evaluation.driver import Depth, PlaceEstimate
from smal.features import FeatureSettings
from smal.model import Model
from smal.movement import MOTIONS, Motion
from smal.paper.learning import LearningSettings
from smal.paper.learning import learn as learn_paper
from smal.paper.model import PaperModel
from smal.paper.robot import PaperRobot
from smal.planning import Said
from smal.robot import Robot
from smal.teaching.demonstration import Demonstration
from smal.teaching.mapping import learn

_MODEL: Final = "model.smal"


class SmalDriver:
    """SMAL: the filter and the planner, at every frame.

    Parameters
    ----------
    model : Model
    goal : str, optional
        Goal of the robot; it can be omitted if all drives lead to the same goal.
    avoids : bool
        Whether the robot drives around obstacles by its depth images.
    """

    def __init__(self, model: Model, goal: str | None = None, *, avoids: bool = True) -> None:
        self._robot = Robot(model, goal)
        self._avoids = avoids
        self.place: PlaceEstimate | None = None

    @classmethod
    def taught(
        cls,
        drives: Sequence[Demonstration],
        folder: Path,
        features: FeatureSettings,
        *,
        avoids: bool = True,
    ) -> "SmalDriver":
        """Learn from drives."""
        file = folder / _MODEL
        if not file.exists():
            learn(drives, features).save(file)
        return cls(Model.load(file), avoids=avoids)

    def reset(self, seed: int) -> None:
        """Start a new episode."""
        self._robot.reset(seed)
        self.place = None

    def step(
        self, image: Uint8s, odometry: Sequence[float], depth: Depth | None, elapsed_s: float
    ) -> Motion:
        """Return the velocity until the next image; see `Driver.step`."""
        robot = self._robot
        motion = robot.step(image, odometry, elapsed_s, depth if self._avoids else None)
        where = robot.where
        self.place = (
            None
            if robot.lost
            else PlaceEstimate(where.frame, where.ahead, where.left, where.turned_rad)
        )
        return motion

    @property
    def said(self) -> Said | None:
        """Announced result."""
        return self._robot.said


class PaperDriver:
    """The paper's scheme: a decision every l frames.

    Parameters
    ----------
    model : PaperModel
    """

    place: PlaceEstimate | None = None

    def __init__(self, model: PaperModel) -> None:
        self._robot = PaperRobot(model)

    @classmethod
    def taught(
        cls, drives: Sequence[Demonstration], folder: Path, features: FeatureSettings, length: int
    ) -> "PaperDriver":
        """Learn from drives, with sequences of `length` frames."""
        file = folder / _MODEL
        if not file.exists():
            settings = LearningSettings(features=features, sequence_length=length)
            learn_paper(drives, settings).save(file)
        return cls(PaperModel.load(file))

    def reset(self, seed: int) -> None:
        """Start a new episode; the scheme has no random numbers."""
        del seed
        self._robot.reset()

    def step(
        self, image: Uint8s, odometry: Sequence[float], depth: Depth | None, elapsed_s: float
    ) -> Motion:
        """Return the velocity until the next image; see `Driver.step`."""
        del odometry, depth, elapsed_s
        return MOTIONS[self._robot.step(image)]

    @property
    def said(self) -> Said | None:
        """Announced result."""
        return "found" if self._robot.done else None

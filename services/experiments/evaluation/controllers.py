"""Who drives in a search: SMAL, or one of its peers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from services.experiments.evaluation.demonstrations import Drive
from smal.evaluation.baselines.nearest_neighbour_imitation import NearestNeighbourImitation
from smal.evaluation.baselines.seqslam_localization import SeqSlamLocalizer
from smal.evaluation.baselines.teach_and_repeat import TaughtDrive, TeachAndRepeat
from smal.features import FeatureSettings, extract
from smal.model import Model
from smal.movement import Atom
from smal.paper.execution import DecisionMaker
from smal.paper.model import Model as PaperModel
from smal.paper.recognition import Recognizer
from smal.place_recognition.seqslam import SeqSlamSettings
from smal.planning import Planner
from smal.robot import Localizer

#: The paper's trajectories of 10 frames. Its neighbourhood of 10 frames is too small for ten frames a second, in which
#: neighbours hardly differ, and what is enhanced is noise: on drives of the indoor world the place was off by more than
#: 2.5 m in one of ten frames, with 40 frames by 0.13 m. On the campus it collides whatever the settings: neighbourhoods
#: of 10 to 160 frames, trajectories of 5 to 40, velocities of 0.5 to 2 (three searches each).
SEQSLAM: Final = SeqSlamSettings(length=10, window=40)
SEQSLAM_FEATURES: Final = FeatureSettings.of(("thumbnail",))

#: What the wheels tell: x, y in metres and heading in radians since the start.
Pose = tuple[float, float, float]


class Seen(NamedTuple):
    """What a controller is shown of a frame.

    Attributes
    ----------
    tick
        Frame number, from 0, without gaps.
    image
        (height, width, 3) RGB.
    features
        (m,), from `smal.features.extract` with the controller's `features`; empty if it wants none.
    odometry
        By the wheels.
    """

    tick: int
    image: NDArray[np.uint8]
    features: NDArray[np.float32]
    odometry: Pose


@dataclass(frozen=True)
class Place:
    """A pose as seen from a taught frame, counted over all drives: metres ahead and left, radians to the left."""

    frame: int
    ahead_m: float
    left_m: float
    turned_rad: float


@dataclass(frozen=True)
class Move:
    """What a controller does at one frame.

    Attributes
    ----------
    atom
        The movement until the next frame.
    decision
        Kind of the decision that was taken at this frame (`smal.planning.Decision`, `smal.paper.execution.Decision`),
        or None where none was due.
    recognized
        Whether that decision knew where the robot is.
    arrived
        Whether the robot says that it is at the goal, which ends the search.
    place
        Where it most likely believes to be, if it says so.
    """

    atom: Atom
    decision: str | None = None
    recognized: bool = True
    arrived: bool = False
    place: Place | None = None


class Controller(Protocol):
    """Drives by what the camera shows."""

    features: FeatureSettings | None
    """Which features it wants of every frame; None for a controller that looks at images only."""

    def reset(self) -> None:
        """Forget everything of the last episode."""

    def act(self, seen: Seen) -> Move:
        """Take one frame, and say what to do."""


def seen_by(controller: Controller, tick: int, image: NDArray[np.uint8], odometry: Pose) -> Seen:
    """Return what a controller is shown of a frame, with the features that it wants."""
    wanted = controller.features
    return Seen(tick, image, np.zeros(0, np.float32) if wanted is None else extract(image, wanted), odometry)


class FilterController:
    """SMAL: the filter and the planner as the services have them.

    Parameters
    ----------
    model
        What was learned.
    goal
        Where to go, in a model with several goals.
    """

    def __init__(self, model: Model, goal: str | None = None) -> None:
        self._map = model.mapped
        self._localizer, self._planner = Localizer(model), Planner(model.mapped, goal)
        self.features: FeatureSettings | None = self._localizer.features
        self.reset()

    def reset(self) -> None:
        """Forget the belief, and what was being done."""
        self._localizer.reset()
        self._planner.reset()
        self._made = [Atom.STOP]

    def act(self, seen: Seen) -> Move:
        """Decide at every frame."""
        belief = self._localizer.observe(seen.features, seen.odometry, self._made).summary()
        decision = self._planner.decide(belief)
        self._made = [decision.atom]
        ahead, left, turned = belief.offsets[0].tolist()
        place = Place(int(self._map.keyframes[belief.keyframes[0]]), ahead, left, turned)
        return Move(decision.atom, decision.kind, belief.lost <= 0.5, self._planner.done, place)


class PaperController:
    """The paper's scheme: a decision every l frames.

    Parameters
    ----------
    model
        What was learned. With l = 1 it is the single image.
    """

    def __init__(self, model: PaperModel) -> None:
        self._length = model.sequence_length
        self._maker, self._recognizer = DecisionMaker(model), Recognizer(model)
        self.features: FeatureSettings | None = model.feature_settings

    def reset(self) -> None:
        """Forget frames and plan."""
        self._recognizer.reset()
        self._maker.reset()

    def act(self, seen: Seen) -> Move:
        """Decide with every whole window, none of which overlap."""
        found = self._recognizer.observe(seen.tick, seen.features, due=(seen.tick + 1) % self._length == 0)
        if found.status == "collecting":
            return Move(self._maker.next_atom())
        decision = self._maker.decide(found)
        return Move(self._maker.next_atom(), decision.kind, found.state is not None)


class ImitationController:
    """Nearest-neighbour imitation: does what was done at the demonstrated moment that looks most alike.

    Parameters
    ----------
    drives
        What it imitates.
    features
        Of the drives, all modalities as their weights say.
    frames
        How many of the last frames it compares.
    """

    def __init__(self, drives: Sequence[Drive], features: FeatureSettings, frames: int = 1) -> None:
        self._imitation = NearestNeighbourImitation([one.demonstration for one in drives], features, frames)
        self.features: FeatureSettings | None = features

    def reset(self) -> None:
        """Forget all frames."""
        self._imitation.reset()

    def act(self, seen: Seen) -> Move:
        """Imitate the nearest frame."""
        return Move(self._imitation.act(seen.features))


class TeachAndRepeatController:
    """Teach and repeat (Dall'Osto et al. 2021): the place by the wheels, corrected by the shift of the image.

    Parameters
    ----------
    drives
        With images.
    field_of_view_rad
        Of the camera, horizontal.
    """

    features: FeatureSettings | None = None

    def __init__(self, drives: Sequence[Drive], field_of_view_rad: float) -> None:
        taught = []
        for one in drives:
            odometry = one.demonstration.odometry
            if odometry is None:
                raise ValueError(f"demonstration {one.demonstration.name} has no odometry")
            grey = np.stack([_grey(image) for image in images_of(one)])
            taught.append(TaughtDrive(grey, odometry, one.demonstration.atoms, field_of_view_rad))
        self._robot = TeachAndRepeat(taught)

    def reset(self) -> None:
        """Forget the episode."""
        self._robot.reset()

    def act(self, seen: Seen) -> Move:
        """Repeat."""
        return Move(self._robot.act(_grey(seen.image), seen.odometry))


def _grey(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), dtype=np.uint8)


class SeqSlamController:
    """SeqSLAM says which demonstrated frame the robot is at, and it does what was done there.

    Parameters
    ----------
    drives
        With images.
    settings
        Of SeqSLAM, `SEQSLAM` unless given.
    """

    features: FeatureSettings | None = SEQSLAM_FEATURES

    def __init__(self, drives: Sequence[Drive], settings: SeqSlamSettings = SEQSLAM) -> None:
        self._localizer = SeqSlamLocalizer(seqslam_templates(drives), settings, shorten=True)
        self._atoms = [one.demonstration.atoms for one in drives]

    def reset(self) -> None:
        """Forget all frames."""
        self._localizer.reset()

    def act(self, seen: Seen) -> Move:
        """Continue the demonstration from the place that the last frames end at."""
        place = self._localizer.observe(seen.features)
        return Move(Atom.STOP if place is None else Atom(int(self._atoms[place.demonstration][place.frame])))


def seqslam_templates(drives: Sequence[Drive]) -> list[NDArray[np.float32]]:
    """Return what SeqSLAM knows of each drive: the features (f, m) of its images."""
    return [np.stack([extract(image, SEQSLAM_FEATURES) for image in images_of(one)]) for one in drives]


def images_of(drive: Drive) -> Sequence[NDArray[np.uint8]]:
    """Return the images of a drive.

    Raises
    ------
    ValueError
        It has none.
    """
    if drive.demonstration.images is None:
        raise ValueError(f"demonstration {drive.demonstration.name} has no images")
    return drive.demonstration.images

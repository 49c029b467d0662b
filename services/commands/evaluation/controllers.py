"""Who drives in a search: SMAL, or one of its peers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np
from numpy.typing import NDArray

from services.commands.evaluation.demonstrations import Drive
from services.commands.evaluation.plan import SCHEMES, Scheme
from smal.action_space import Atom
from smal.decision import DecisionMaker
from smal.evaluation.baselines.behaviour_cloning import ClonedBehaviour
from smal.evaluation.baselines.nearest_neighbour_imitation import NearestNeighbourImitation
from smal.evaluation.baselines.seqslam_localisation import SeqSlamLocaliser, state_at
from smal.evaluation.baselines.thumbnails import thumbnail
from smal.features import FeatureSettings
from smal.model import Model
from smal.place_recognition.seqslam import SeqSlamSettings
from smal.recognition import Recognition, Recognizer

#: The paper's trajectories of 10 frames. Its neighbourhood of 10 frames is too small for ten frames a second, in which
#: neighbours hardly differ, and what is enhanced is noise: on drives of the indoor world the place was off by more than
#: 2.5 m in one of ten frames, with 40 frames by 0.13 m. On the campus it collides whatever the settings: neighbourhoods
#: of 10 to 160 frames, trajectories of 5 to 40, velocities of 0.5 to 2 (three searches each).
SEQSLAM: Final = SeqSlamSettings(length=10, window=40)


@dataclass(frozen=True)
class Move:
    """What a controller does at one frame.

    Attributes
    ----------
    atom
        The movement until the next frame.
    decision
        Kind of the decision that was taken at this frame (`smal.decision.Decision`), or None where none was due.
    recognised
        Whether that decision knew where the robot is.
    """

    atom: Atom
    decision: str | None = None
    recognised: bool = True


class Controller(Protocol):
    """Drives by what the camera shows."""

    @property
    def features(self) -> FeatureSettings | None:
        """Which features it wants of every frame; None for a controller that looks at images only."""

    def reset(self) -> None:
        """Forget everything of the last episode."""

    def act(self, tick: int, image: NDArray[np.uint8], raw_features: NDArray[np.float32] | None) -> Move:
        """Take one frame, and say what to do.

        Parameters
        ----------
        tick
            Frame number, from 0, without gaps.
        image
            (height, width, 3) RGB.
        raw_features
            (m,), from `smal.features.extract` with `features`; None if it wants none.
        """


class SmalController:
    """The method: recognition and decision as the services do it.

    Parameters
    ----------
    model
        What was learned. With l = 1 it is the single image, everything else being equal.
    scheme
        How it decides.
    """

    def __init__(self, model: Model, scheme: Scheme = SCHEMES["smal"]) -> None:
        self._length = model.sequence_length
        self._stride = scheme.stride(self._length)
        self._maker = DecisionMaker(
            model, self._stride, aligned=scheme.aligned, belief=scheme.belief, coast=scheme.coast
        )
        self._recognizer = Recognizer(model, shorten=scheme.shorten)
        self._features = model.feature_settings

    @property
    def features(self) -> FeatureSettings:
        """Those of the model."""
        return self._features

    def reset(self) -> None:
        """Forget frames and plan."""
        self._recognizer.reset()
        self._maker.reset()

    def act(self, tick: int, image: NDArray[np.uint8], raw_features: NDArray[np.float32] | None) -> Move:
        """Decide where a decision is due: with the first whole window, then at equal distances."""
        assert raw_features is not None  # noqa: S101 - it asks for them
        due = (tick + 1 - self._length) % self._stride == 0
        found = self._recognizer.observe(tick, raw_features, due)
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
        self._features = features

    @property
    def features(self) -> FeatureSettings:
        """Those of the drives."""
        return self._features

    def reset(self) -> None:
        """Forget all frames."""
        self._imitation.reset()

    def act(self, tick: int, image: NDArray[np.uint8], raw_features: NDArray[np.float32] | None) -> Move:
        """Imitate the nearest frame."""
        assert raw_features is not None  # noqa: S101 - it asks for them
        return Move(self._imitation.act(raw_features))


class CloningController:
    """Behaviour cloning: a network says which key the expert would hold."""

    features: FeatureSettings | None = None

    def __init__(self, cloned: ClonedBehaviour) -> None:
        self._cloned = cloned

    def reset(self) -> None:
        """Nothing to forget: it looks at one image."""

    def act(self, tick: int, image: NDArray[np.uint8], raw_features: NDArray[np.float32] | None) -> Move:
        """Ask the network."""
        return Move(self._cloned.act(thumbnail(image)))


class SeqSlamController:
    """SeqSLAM says where in the demonstrations the robot is, and SMAL's policy what to do there.

    The demonstrated frame becomes the model's state there and the phase in it; the rest is as in `SmalController`
    with "aligned". There is one place and no belief.

    Parameters
    ----------
    model
        Learned from the drives; its policy decides.
    drives
        With thumbnails.
    stride
        Frames from one decision to the next.
    settings
        Of SeqSLAM, `SEQSLAM` unless given.

    Raises
    ------
    ValueError
        A drive of the model is not there, is another one, or has no thumbnails.
    """

    features: FeatureSettings | None = None

    def __init__(
        self, model: Model, drives: Sequence[Drive], stride: int = 1, settings: SeqSlamSettings = SEQSLAM
    ) -> None:
        thumbnails = {one.demonstration.name: one.thumbnails for one in drives if one.thumbnails is not None}
        self._localiser = SeqSlamLocaliser(thumbnails, model.names, settings, shorten=True)
        for name, atoms in zip(model.names, model.atoms, strict=True):
            if len(thumbnails[name]) != len(atoms):
                raise ValueError(f"drive {name} has {len(thumbnails[name])} frames, and the model's has {len(atoms)}")
        self._maker = DecisionMaker(model, stride, belief=False)
        self._model, self._stride, self._length = model, stride, settings.length

    def reset(self) -> None:
        """Forget frames and plan."""
        self._localiser.reset()
        self._maker.reset()

    def act(self, tick: int, image: NDArray[np.uint8], raw_features: NDArray[np.float32] | None) -> Move:
        """Decide where a decision is due, by the place that the last frames end at."""
        place = self._localiser.observe(thumbnail(image))
        if place is None or (tick + 1 - self._length) % self._stride != 0:
            return Move(self._maker.next_atom())
        state, phase = state_at(self._model, place.demonstration, place.frame)
        decision = self._maker.decide(Recognition("recognized", tick, state, phase))
        return Move(self._maker.next_atom(), decision.kind)

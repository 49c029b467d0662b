"""Where in what was taught the robot is."""

import math
from typing import Annotated, ClassVar, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from schemas.base import Message, Strict

MAX_PLACES = 100  # Room for a belief; recognition sends fewer (`smal.settings`).
_FAR_M = (
    1e6  # Farther places are moved to this distance: no robot drives there, but odometry may jump.
)


class Place(Strict):
    """A pose beside a taught keyframe, where the robot may be."""

    keyframe: Annotated[int, Field(ge=0, le=1_000_000)]
    """Its number in the model's map of views."""
    ahead_m: Annotated[float, Field(ge=-_FAR_M, le=_FAR_M)]
    """How far ahead of the keyframe the robot is, along its heading."""
    left_m: Annotated[float, Field(ge=-_FAR_M, le=_FAR_M)]
    """How far to the left of it."""
    turned_rad: Annotated[float, Field(ge=-3.2, le=3.2)]
    """How far the robot is turned against it, counter-clockwise."""
    weight: Annotated[float, Field(ge=0, le=1.001)]
    """Probability of being there, given that the robot is not lost."""


class State(Message):
    """Answer of recognition for one frame; only ``recognized`` and ``unknown`` call for a decision.

    By the filter it is a belief over places; by the paper's scheme the learned state of Eq. 9.
    """

    topic: ClassVar[str] = "state"

    status: Literal["idle", "collecting", "recognized", "unknown"]
    """idle: no model; collecting: no decision is due at this frame; unknown: the robot is more likely lost than not, or
    no learned state has a weight."""
    model: Annotated[str | None, Field(pattern=r"^[0-9a-f]{8,64}$")] = None
    """Beginning of the checksum of the model that the state belongs to; a policy refuses another's. None when idle."""
    places: Annotated[tuple[Place, ...], Field(max_length=MAX_PLACES)] = ()
    """The filter's belief, heaviest first; empty in the paper's scheme."""
    lost: Annotated[float, Field(ge=0, le=1)] = 0.0
    """Probability that the robot is nowhere near what was taught; of the filter."""
    cosine: Annotated[float, Field(ge=-1.1, le=1.1)] = 0.0
    """Mean cosine between the view and those of the places; of the filter."""
    tracked_m: Annotated[float, Field(ge=0, le=1e9)] = 0.0
    """Way that the robot was followed for without a jump; of the filter."""
    unseen_m: Annotated[float, Field(ge=0, le=1e9)] = 0.0
    """Way since a view last spoke for the robot's place; of the filter."""
    camera: Literal["sees", "blank", "frozen"] = "sees"
    """Whether the picture shows anything: blank has no texture, frozen stays the same while the wheels move."""
    seen: Annotated[float | None, Field(ge=0, le=1)] = None
    """Probability that what is sought is in view; none where nothing is known of it; of the filter."""
    near: Annotated[float, Field(ge=0, le=1e3)] = 0.0
    """Distance from it where the taught ways ended, over the distance now, by how much of the view speaks for it."""
    seen_left: Annotated[float | None, Field(ge=-0.5, le=0.5)] = None
    """How far left of the middle of the view it is, as a share of the width; none where it is hidden."""
    strange_m: Annotated[float | None, Field(ge=0, le=1e6)] = None
    """How far ahead the ground looks as none of the taught one, where that is looked at; none where nothing does."""
    state: Annotated[int | None, Field(ge=0, le=1_000_000)] = None
    """Index of the learned state, when recognized by the paper's scheme."""
    score: Annotated[float, Field(ge=0, le=1e9)] = 0.0
    """Weight of the matched sequence over the sequence length (Eq. 9 divided by l)."""
    total_weight: Annotated[float, Field(ge=0, le=1e9)] = 0.0
    """Weight of all sequences over the sequence length."""
    residual: Annotated[float, Field(ge=0, le=1)] = 1.0
    """Share of the query that the templates leave unexplained, 0 to 1."""
    agreement: Annotated[float, Field(ge=-1.01, le=1.01)] = 0.0
    """Mean cosine between the query frames and the nearest frames of the matched sequence."""
    duality_gap: Annotated[float, Field(ge=0, le=1e9)] = 0.0
    """How far the weights are from the optimum of Eq. 7 at most, relative."""

    @classmethod
    def of_belief(
        cls,
        observation: Message,
        model: str,
        keyframes: NDArray[np.intp],
        offsets: NDArray[np.float64],
        weights: NDArray[np.float64],
        seen: tuple[float, float, float | None] | None = None,
        strange_m: float = math.inf,
        camera: Literal["sees", "blank", "frozen"] = "sees",
        **of_all: float,
    ) -> Self:
        """Tell a belief over places: keyframes (p,), offsets (p, 3) and weights (p,), the heaviest first.

        ``seen`` is the probability that what is sought is in view, how near it is, and how far to the left;
        ``strange_m`` is how far ahead the ground looks strange; ``of_all`` are the other fields of the filter: lost,
        cosine, tracked_m and unseen_m.
        """
        places = tuple(
            Place(keyframe=keyframe, ahead_m=ahead, left_m=left, turned_rad=turned, weight=weight)
            for keyframe, (ahead, left, turned), weight in zip(
                keyframes.tolist(),
                offsets.clip(-_FAR_M, _FAR_M).tolist(),
                weights.tolist(),
                strict=True,
            )
        )
        lost = min(of_all.pop("lost"), 1.0)
        status = "unknown" if lost > 0.5 else "recognized"
        told = {} if seen is None else dict(zip(("seen", "near", "seen_left"), seen, strict=True))
        told |= {"strange_m": strange_m} if math.isfinite(strange_m) else {}
        return cls.after(
            observation,
            status=status,
            model=model,
            places=places,
            lost=lost,
            camera=camera,
            **told,
            **of_all,
        )

    def belief(self) -> tuple[NDArray[np.intp], NDArray[np.float64], NDArray[np.float64]]:
        """Return what `of_belief` was given: keyframes (p,), offsets (p, 3) and weights (p,)."""
        return (
            np.array([place.keyframe for place in self.places], dtype=np.intp),
            np.array(
                [(place.ahead_m, place.left_m, place.turned_rad) for place in self.places]
            ).reshape(-1, 3),
            np.array([place.weight for place in self.places]),
        )

    @model_validator(mode="after")
    def _check(self) -> Self:
        if sum(place.weight for place in self.places) > 1.01:
            raise ValueError("the weights of places sum to 1 at most")
        if (self.model is None) != (self.status == "idle"):
            raise ValueError("the model is given exactly when the status is not 'idle'")
        of_paper = self.status == "recognized" and not self.places
        if (self.state is not None) != of_paper:
            raise ValueError(
                "a state is given exactly when the status is 'recognized' without places"
            )
        return self

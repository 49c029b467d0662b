"""Where in what was taught the robot is."""

from typing import Annotated, ClassVar, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, Field, model_validator

from schemas.array import Float32Array
from schemas.base import Message

MAX_PLACES = 100  # Room for a belief; recognition sends fewer (`smal.filter.PLACES`).
FAR_M = 1e6  # No robot drives farther from a keyframe, but odometry may jump.
#: Least and greatest value of each column of `State.places`.
_PLACE_RANGES = np.array(
    [(0, 1_000_000), (-FAR_M, FAR_M), (-FAR_M, FAR_M), (-3.2, 3.2), (0, 1.001)], np.float32
)


def _check_places(places: Float32Array) -> Float32Array:
    if len(places.shape) != 2 or places.shape[0] > MAX_PLACES or places.shape[1] != 5:
        raise ValueError(f"places must be (n, 5), n at most {MAX_PLACES}, got {places.shape}")
    rows = places.to_numpy()
    least, greatest = _PLACE_RANGES.T
    if not ((least <= rows) & (rows <= greatest)).all() or (rows[:, 0] % 1).any():
        raise ValueError("a place must be keyframe, ahead_m, left_m, turned_rad, weight in range")
    if rows[:, 4].sum() > 1.01:
        raise ValueError("the weights of places must sum to at most 1")
    return places


#: A belief without a place.
NO_PLACES = Float32Array(shape=(0, 5), data=b"")


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
    places: Annotated[Float32Array, AfterValidator(_check_places)] = NO_PLACES
    """The filter's belief as rows, heaviest first; empty in the paper's scheme.

    Columns: keyframe in the model's map; metres ahead of the keyframe and to its left; turn against it, radians
    counter-clockwise; probability of being there, given that the robot is not lost.
    """
    lost: Annotated[float, Field(ge=0, le=1)] = 0.0
    """Probability that the robot is nowhere near what was taught; of the filter."""
    cosine: Annotated[float, Field(ge=-1.1, le=1.1)] = 0.0
    """Mean cosine between the view and those of the places; of the filter."""
    tracked_m: Annotated[float, Field(ge=0, le=1e9)] = 0.0
    """Way that the robot was followed for without a jump; of the filter."""
    evidence: Annotated[float, Field(ge=-1e9, le=1e9)] = 0.0
    """Log of how much likelier the last view was, after all before it, than a view elsewhere; of the filter."""
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

    @property
    def keyframes(self) -> NDArray[np.intp]:
        """The keyframe (n,) of each place."""
        return self.places.to_numpy()[:, 0].astype(np.intp)

    @property
    def weights(self) -> NDArray[np.float32]:
        """The weight (n,) of each place."""
        return self.places.to_numpy()[:, 4]

    @model_validator(mode="after")
    def _check(self) -> Self:
        if (self.model is None) != (self.status == "idle"):
            raise ValueError("the model is given exactly when the status is not 'idle'")
        of_paper = self.status == "recognized" and not len(self.weights)
        if (self.state is not None) != of_paper:
            raise ValueError(
                "a state is given exactly when the status is 'recognized' without places"
            )
        return self

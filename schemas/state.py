"""The robot's estimated position along the taught ways."""

from typing import Annotated, ClassVar, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, Field, model_validator

from schemas.array import Float32Array
from schemas.base import Message

# Maximum size of a belief; recognition sends fewer places (`smal.filter.PLACES`).
MAX_PLACES = 100
FAR_M = 1e6  # Maximum distance from a keyframe, metres: beyond any drive, but odometry can jump.
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
        raise ValueError(
            "invalid place: keyframe, ahead_m, left_m, turned_rad or weight is out of range"
        )
    if rows[:, 4].sum() > 1.01:
        raise ValueError("the weights of places must sum to at most 1")
    return places


NO_PLACES = Float32Array(shape=(0, 5), data=b"")


class State(Message):
    """Result of recognition for one frame; ``recognized`` and ``unknown`` require a decision.

    By the filter it is a belief over places; by the paper's scheme the learned state of Eq. 9.
    """

    topic: ClassVar[str] = "state"

    status: Literal["idle", "collecting", "recognized", "unknown"]
    """idle: no model. collecting: no decision is due at this frame. unknown: the robot is probably
    lost, or no learned state has a weight.
    """
    model: Annotated[str | None, Field(pattern=r"^[0-9a-f]{8,64}$")] = None
    """Beginning of the checksum of the model; a policy refuses states of another model. None when
    idle.
    """
    places: Annotated[Float32Array, AfterValidator(_check_places)] = NO_PLACES
    """Belief of the filter as rows, heaviest first; empty in the paper's scheme.

    Columns: keyframe in the model's map; metres ahead of the keyframe and to its left; turn against
    it, radians counter-clockwise; probability of the place, given that the robot is not lost.
    """
    lost: Annotated[float, Field(ge=0, le=1)] = 0.0
    """Probability that the robot is off the taught ways (filter only)."""
    cosine: Annotated[float, Field(ge=-1.1, le=1.1)] = 0.0
    """Mean cosine between the view and the views of the places (filter only)."""
    tracked_m: Annotated[float, Field(ge=0, le=1e9)] = 0.0
    """Distance tracked without a jump, metres (filter only)."""
    evidence: Annotated[float, Field(ge=-1e9, le=1e9)] = 0.0
    """Log likelihood ratio of the last view, given all before it, against a view elsewhere (filter
    only).
    """
    unseen_m: Annotated[float, Field(ge=0, le=1e9)] = 0.0
    """Distance since a view last confirmed the robot's place, metres (filter only)."""
    support: Annotated[float | None, Field(ge=0, le=1e9)] = None
    """Sum of the evidence since the start, or since the robot was last lost (filter only)."""
    camera: Literal["sees", "blank", "frozen"] = "sees"
    """State of the camera: blank has no texture, frozen stays the same while the wheels move."""
    pitch_deg: Annotated[float, Field(ge=-90, le=90)] = 0.0
    """Estimated angle by which the camera points further down than when it was taught, degrees
    (filter only).
    """
    moved_m: Annotated[float | None, Field(ge=-1e9, le=1e9)] = None
    """Way ahead since the frame before, by odometry, metres; None unless the robot executed
    motions ahead.
    """
    seen: Annotated[float | None, Field(ge=0, le=1)] = None
    """Probability that the target is in view; None if there is no target detector (filter only)."""
    near: Annotated[float, Field(ge=0, le=1e3)] = 0.0
    """Distance from the target at the end of the taught ways, divided by the distance now."""
    seen_left: Annotated[float | None, Field(ge=-0.5, le=0.5)] = None
    """Offset of the target to the left of the image's centre, as a share of the width; None if
    hidden.
    """
    strange_m: Annotated[float | None, Field(ge=0, le=1e6)] = None
    """Distance ahead to unexpected ground, metres; None if the ground is as taught or is not
    checked.
    """
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
    """Upper bound of the relative distance of the weights from the optimum of Eq. 7."""

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

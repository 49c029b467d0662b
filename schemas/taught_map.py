"""Keyframes of the loaded model."""

from typing import Annotated, ClassVar, Self

from pydantic import Field, model_validator

from schemas.array import Float32Array
from schemas.base import Message

# Maximum number of keyframes, see `schemas.state.Place`.
_MOST_KEYFRAMES = 1_000_000


class TaughtMap(Message):
    """Poses of the taught keyframes, sent once per episode and model with the first belief."""

    topic: ClassVar[str] = "map"
    max_bytes: ClassVar[int] = 12 * _MOST_KEYFRAMES + 64 * 1024

    model: Annotated[str, Field(pattern=r"^[0-9a-f]{8,64}$")]
    """Beginning of the checksum of the model, as in its states."""
    keyframes: Float32Array
    """Poses, shape (k, 3): x, y in metres (in forward atoms for a drive without odometry) and
    heading in radians, counter-clockwise from the x axis. Drives that share places share the
    axes of their first drive; other drives have their own axes.
    """
    begins: Annotated[
        tuple[Annotated[int, Field(ge=0, le=_MOST_KEYFRAMES)], ...],
        Field(min_length=1, max_length=1000),
    ]
    """First keyframe of each drive, ascending from 0. If there are too many drives, the last entry
    covers the rest.
    """

    @model_validator(mode="after")
    def _check(self) -> Self:
        shape = self.keyframes.shape
        if len(shape) != 2 or shape[1] != 3 or not 1 <= shape[0] <= _MOST_KEYFRAMES:
            raise ValueError(f"keyframes of shape {shape}, expected (k, 3)")
        rising = all(one < other for one, other in zip(self.begins, self.begins[1:], strict=False))
        if self.begins[0] != 0 or not rising or self.begins[-1] >= shape[0]:
            raise ValueError("begins must rise from 0 and stay below the number of keyframes")
        return self

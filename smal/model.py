"""What a robot goes by: the features of a frame, and the visual map of the taught ways, as one file."""

from dataclasses import dataclass
from typing import Any, Self

from numpy.typing import NDArray

from smal.features import Centering, FeatureSettings
from smal.files.map_file import content_of_map, parts_of_map
from smal.files.stored import Content, Stored, features_of, of_features
from smal.visual_map import VisualMap


@dataclass(frozen=True, eq=False)
class Model(Stored):
    """What `smal.fit` and `smal.learn` make, and `smal.Robot` takes.

    Parameters
    ----------
    centering : Centering
        Turns raw features into those of the map's views.
    mapped : VisualMap
        The taught ways, and how they look.
    """

    scheme = "filter"

    centering: Centering
    mapped: VisualMap

    def __post_init__(self) -> None:
        if len(self.mapped.basis) != self.feature_settings.size:
            raise ValueError(
                f"the map has views of {len(self.mapped.basis)} features, a frame has {self.feature_settings.size}"
            )

    @property
    def feature_settings(self) -> FeatureSettings:
        """Features of a frame that it goes by."""
        return self.centering.settings

    @property
    def longest(self) -> int:
        """Frames of the longest drive."""
        return int(self.mapped.frames.max())

    def __repr__(self) -> str:
        """Say what it is, not all its numbers."""
        return (
            f"Model({len(self.mapped.keyframes)} keyframes of {len(self.mapped.goals)} drives, "
            f"{'+'.join(self.feature_settings.modalities)})"
        )

    def content(self) -> Content:
        """Return what its file says of it, and the arrays in it."""
        numbers, arrays = content_of_map(self.mapped)
        return of_features(self.feature_settings) | {"map": numbers}, arrays | {"mean": self.centering.mean}

    @classmethod
    def of_content(cls, meta: dict[str, Any], arrays: dict[str, NDArray[Any]]) -> Self:
        """Make it of what a file says."""
        mean = arrays.pop("mean")
        return cls(Centering(mean, features_of(meta)), VisualMap(**parts_of_map(meta["map"], arrays)))

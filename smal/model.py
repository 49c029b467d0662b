"""A model: the map, the features of a frame, and what is known of the goals and of the ground.

`smal.teaching.mapping` makes a model of drives, and a robot goes by it.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Self

from numpy.typing import NDArray

from smal.features import Centering, FeatureSettings
from smal.files.stored import Content, Stored
from smal.map import VisualMap
from smal.obstacles.strange import Ground
from smal.sought.sight import Sight, content_of_sights, sights_of_content
from smal.sought.word import Word, content_of_words, words_of_content


@dataclass(frozen=True, eq=False)
class Model(Stored):
    """What `smal.fit` and `smal.learn` make, and `smal.Robot` takes: a map, and what centres a frame's features."""

    scheme = "filter"

    centering: Centering
    mapped: VisualMap
    #: What is sought at each goal; of one that has none, a robot that has arrived says that it has found it.
    sights: Mapping[str, Sight] = field(default_factory=dict)
    words: Mapping[str, Word] = field(default_factory=dict)  # And what detectors say of it.
    ground: Ground | None = None  # How the ground looks, if that is known.

    def __post_init__(self) -> None:
        if len(self.mapped.basis) != self.feature_settings.size:
            raise ValueError(
                f"the map has views of {len(self.mapped.basis)} features, a frame has {self.feature_settings.size}"
            )
        if self.ground is not None and len(self.ground.colours) != len(self.mapped.keyframes):
            raise ValueError("the ground is known of other keyframes than those of the map")

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
        sees = "+".join(self.feature_settings.modalities)
        return f"Model({len(self.mapped.keyframes)} keyframes of {len(self.mapped.goals)} drives, {sees})"

    def content(self) -> Content:
        """Return what its file says of it, and the arrays in it."""
        numbers, arrays = self.mapped.content()
        sights, cells = content_of_sights(self.sights)
        words, ratios = content_of_words(self.words)
        meta = self.feature_settings.content | {"map": numbers, "sights": sights, "words": words}
        arrays |= cells | ratios | {"mean": self.centering.mean}
        if self.ground is not None:
            meta = meta | {"strange": self.ground.strange}
            arrays = arrays | {"ground": self.ground.colours}
        return meta, arrays

    @classmethod
    def of_content(cls, meta: dict[str, Any], arrays: dict[str, NDArray[Any]]) -> Self:
        """Make it of what a file says."""
        mean = arrays.pop("mean")
        sights = sights_of_content(meta["sights"], arrays)
        words = words_of_content(meta["words"], arrays)
        ground = Ground(arrays.pop("ground"), meta["strange"]) if "strange" in meta else None
        mapped = VisualMap.of_content(meta["map"], arrays)
        return cls(Centering(mean, FeatureSettings.of_content(meta)), mapped, sights, words, ground)

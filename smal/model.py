"""The model: the map, the features of a frame, the targets, and the ground.

`smal.teaching.mapping` builds a model from drives; a robot drives by it.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Self

from smal.arrays import AnyArray
from smal.features import Centering, FeatureSettings
from smal.files.stored import Content, Stored
from smal.map import VisualMap
from smal.obstacles.strange import Ground
from smal.sought.sight import Sight, content_of_sights, sights_of_content
from smal.sought.word import Word, content_of_words, words_of_content


@dataclass(frozen=True, eq=False)
class Model(Stored):
    """Result of `smal.fit` and `smal.learn`, and input of `smal.Robot`."""

    scheme = "filter"

    centering: Centering
    mapped: VisualMap
    #: Target of each goal. Without a target, a robot that has arrived reports the goal as found.
    sights: Mapping[str, Sight] = field(default_factory=dict)
    #: Detections of the target of each goal.
    words: Mapping[str, Word] = field(default_factory=dict)
    #: Appearance of the ground, if known.
    ground: Ground | None = None
    #: Name of the world of all drives; empty if it is unknown or differs.
    world: str = ""

    def __post_init__(self) -> None:
        features = len(self.mapped.basis)
        size = self.feature_settings.size
        if features != size:
            raise ValueError(f"the map has views of {features} features, a frame has {size}")
        if self.ground is not None and len(self.ground.colours) != len(self.mapped.keyframes):
            raise ValueError("the ground has other keyframes than the map")

    @property
    def feature_settings(self) -> FeatureSettings:
        """Settings of the features of a frame."""
        return self.centering.settings

    @property
    def longest(self) -> int:
        """Number of frames of the longest drive."""
        return int(self.mapped.frames.max())

    def __repr__(self) -> str:
        """Return a summary without the arrays."""
        keyframes = len(self.mapped.keyframes)
        drives = self.mapped.drive_count
        modalities = "+".join(self.feature_settings.modalities)
        return f"Model({keyframes} keyframes of {drives} drives, {modalities})"

    def content(self) -> Content:
        """Return the metadata and the arrays of the model file."""
        numbers, arrays = self.mapped.content()
        sights, cells = content_of_sights(self.sights)
        words = content_of_words(self.words)
        meta = self.feature_settings.content | {"map": numbers, "sights": sights, "words": words}
        arrays |= cells | {"mean": self.centering.mean}
        if self.ground is not None:
            meta = meta | {"strange": self.ground.strange}
            arrays = arrays | {"ground": self.ground.colours}
        if self.world:
            meta = meta | {"world": self.world}
        return meta, arrays

    @classmethod
    def of_content(cls, meta: dict[str, Any], arrays: dict[str, AnyArray]) -> Self:
        """Build the model from the content of a file."""
        mean = arrays.pop("mean")
        sights = sights_of_content(meta["sights"], arrays)
        words = words_of_content(meta["words"])
        ground = None
        if "strange" in meta:
            ground = Ground(arrays.pop("ground"), meta["strange"])
        mapped = VisualMap.of_content(meta["map"], arrays)
        centering = Centering(mean, FeatureSettings.of_content(meta))
        world = meta.get("world", "")
        if not isinstance(world, str):
            raise TypeError(f"the world is not a name: {world!r}")
        return cls(centering, mapped, sights, words, ground, world)

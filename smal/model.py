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
from smal.obstacles.ground import Ground
from smal.target.appearance import TargetAppearance, appearances_of_content, content_of_appearances
from smal.target.label import TargetLabel, content_of_labels, labels_of_content


@dataclass(frozen=True, eq=False)
class Model(Stored):
    """Result of `smal.fit` and `smal.learn`, and input of `smal.Robot`."""

    scheme = "filter"

    centering: Centering
    mapped: VisualMap
    #: Target of each goal, by its appearance. Without a target, a robot that has arrived reports the goal as found.
    appearances: Mapping[str, TargetAppearance] = field(default_factory=dict)
    #: Detections of the target of each goal.
    labels: Mapping[str, TargetLabel] = field(default_factory=dict)
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
        appearances, cells = content_of_appearances(self.appearances)
        labels = content_of_labels(self.labels)
        meta = self.feature_settings.content | {
            "map": numbers,
            "appearances": appearances,
            "labels": labels,
        }
        arrays |= cells | {"mean": self.centering.mean}
        if self.ground is not None:
            meta = meta | {"ground_threshold": self.ground.threshold}
            arrays = arrays | {"ground": self.ground.colours}
        if self.world:
            meta = meta | {"world": self.world}
        return meta, arrays

    @classmethod
    def of_content(cls, meta: dict[str, Any], arrays: dict[str, AnyArray]) -> Self:
        """Build the model from the content of a file."""
        mean = arrays.pop("mean")
        appearances = appearances_of_content(meta["appearances"], arrays)
        labels = labels_of_content(meta["labels"])
        ground = None
        if "ground_threshold" in meta:
            ground = Ground(arrays.pop("ground"), meta["ground_threshold"])
        mapped = VisualMap.of_content(meta["map"], arrays)
        centering = Centering(mean, FeatureSettings.of_content(meta))
        world = meta.get("world", "")
        if not isinstance(world, str):
            raise TypeError(f"the world is not a name: {world!r}")
        return cls(centering, mapped, appearances, labels, ground, world)

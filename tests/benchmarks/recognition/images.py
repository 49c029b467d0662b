"""Frames of real cameras, from folders of images as `smal match` reads them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from services.experiments.matching import image_folder
from services.experiments.matching.image_folder import describe_frames, list_folder
from services.kit.errors import JobError
from smal.features import Centering, FeatureSettings
from tests.benchmarks.recognition.datasets import Recorded
from tests.benchmarks.results import LeftOutError


@dataclass(frozen=True)
class ImageFolder:
    """Which images are templates and which are queries."""

    name: str
    templates: image_folder.ImageFolder
    queries: image_folder.ImageFolder

    @classmethod
    def find(cls, folder: Path) -> ImageFolder:
        """List a folder: ``ref`` and ``query`` in it are two traverses; otherwise its second half are queries."""
        name = f"real:{'/'.join(folder.resolve().parts[-2:])}"
        if (folder / "ref").is_dir() and (folder / "query").is_dir():
            return cls(name, list_folder(folder / "ref", "--images"), list_folder(folder / "query", "--images"))
        every = list_folder(folder, "--images")
        half = len(every.frames) // 2
        return cls(name, replace(every, frames=every.frames[:half]), replace(every, frames=every.frames[half:]))

    def read(self) -> Recorded:
        """Compute the features, centred with the mean of the templates.

        Raises
        ------
        LeftOutError
            No image can be read.
        """
        settings = FeatureSettings()
        try:
            templates, queries = (
                describe_frames(one, settings, None, f"reading {one.path.name}").features
                for one in (self.templates, self.queries)
            )
        except JobError as error:
            raise LeftOutError(str(error)) from None
        centering = Centering.fit(templates, settings)
        return Recorded(self.name, [centering.apply(templates)], [centering.apply(queries)])

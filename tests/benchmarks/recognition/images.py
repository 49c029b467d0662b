"""Frames of real cameras, from folders of images."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import cv2
import numpy as np
from tqdm import tqdm

from services.kit.errors import UsageError
from smal.features import Centering, FeatureSettings, extract
from tests.benchmarks.recognition.datasets import Frames, Recorded
from tests.benchmarks.results import LeftOutError

_SUFFIXES: Final = frozenset({".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp"})


@dataclass(frozen=True)
class ImageFolder:
    """Which images are templates and which are queries.

    Parameters
    ----------
    name : str
    templates, queries : list of Path
        In natural order.
    """

    name: str
    templates: list[Path]
    queries: list[Path]

    @classmethod
    def find(cls, folder: Path) -> ImageFolder:
        """List a folder: ``ref`` and ``query`` in it are two traverses; otherwise its second half are queries.

        Raises
        ------
        UsageError
            There is no such folder, or there are no images.
        """
        if not folder.is_dir():
            raise UsageError(f"--images {folder}: no such folder")
        name = f"real:{'/'.join(folder.resolve().parts[-2:])}"
        if (folder / "ref").is_dir() and (folder / "query").is_dir():
            found = cls(name, _images(folder / "ref"), _images(folder / "query"))
        else:
            images = _images(folder)
            found = cls(name, images[: len(images) // 2], images[len(images) // 2 :])
        if not (found.templates and found.queries):
            raise UsageError(f"--images {folder}: needs images, in it or in its folders ref and query")
        return found

    def read(self) -> Recorded:
        """Compute the features, centred with the mean of the templates.

        Raises
        ------
        LeftOutError
            An image cannot be read.
        """
        settings = FeatureSettings()
        templates, queries = _features(self.templates, settings), _features(self.queries, settings)
        centering = Centering.fit(templates, settings)
        return Recorded(self.name, [centering.apply(templates)], [centering.apply(queries)])


def _images(folder: Path) -> list[Path]:
    found = [path for path in folder.iterdir() if path.suffix.lower() in _SUFFIXES]
    return sorted(found, key=lambda path: [int(t) if t.isdecimal() else t for t in re.split(r"(\d+)", path.name)])


def _features(paths: list[Path], settings: FeatureSettings) -> Frames:
    rows = []
    for path in tqdm(paths, desc=f"reading {paths[0].parent.name}", unit="image", dynamic_ncols=True, leave=False):
        image = cv2.imread(str(path), cv2.IMREAD_COLOR)
        if image is None:
            raise LeftOutError(f"{path}: cannot be read as an image")
        try:
            rows.append(extract(np.asarray(image[:, :, ::-1], dtype=np.uint8), settings))
        except ValueError as error:
            raise LeftOutError(f"{path}: {error}") from None
    return np.stack(rows)

"""Feature modalities by name."""

from typing import Final

from smal.features import color, depth, detectors, gist, hog, ldb, onnx, thumbnail
from smal.features.modality import Modality, detector

#: Modalities without a file.
MODALITIES: Final = {
    modality.name: modality
    for modality in (
        Modality("color", color.SIZE, "color", color.color_descriptor),
        Modality("hog", hog.SIZE, "color", hog.hog_descriptor),
        Modality("depth", depth.SIZE, "depth", depth.depth_descriptor),
        Modality("gist", gist.SIZE, "color", gist.gist_descriptor),
        Modality("ldb", ldb.SIZE, "color", ldb.ldb_descriptor),
        Modality("thumbnail", thumbnail.SIZE, "color", thumbnail.thumbnail_descriptor),
        detector("apriltag", detectors.apriltags),
        detector("qr", detectors.qr_codes),
    )
}

#: Names for users.
MODALITY_NAMES = (*MODALITIES, f"{onnx.PREFIX}FILE", f"{onnx.BOXES}FILE")


def modality_named(name: str) -> Modality:
    """Return one of `MODALITIES`, or a network by its contents (`smal.features.onnx`), without reading a file.

    ValueError if the name is unknown.
    """
    if name in MODALITIES:
        return MODALITIES[name]
    # A damaged model can contain a number as name.
    if str(name).startswith(onnx.PREFIX):
        return onnx.onnx_modality(str(name))
    raise ValueError(f"unknown feature modality {name!r}; known are {', '.join(MODALITY_NAMES)}")

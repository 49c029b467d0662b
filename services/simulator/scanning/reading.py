"""Read a scan (glTF, OBJ or PLY) into textured triangles, with its unit and its up axis."""

import io
import json
import math
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
import trimesh
from numpy.typing import NDArray
from PIL import Image, ImageChops
from scipy.signal import find_peaks
from trimesh.visual import ColorVisuals
from trimesh.visual.material import Material

from schemas.codec import printable
from services.kit.world_files import scan_format
from services.simulator.scanning.faces import PartFaces
from services.simulator.scanning.mesh_file import ScanPart
from services.simulator.world.place import WorldError

# Metres of the units that files have, in the order in which they are tried.
_UNITS: Final = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254, "ft": 0.3048}
# Axes that become x, y and z, for each up axis: rows of a rotation.
_ROTATIONS: Final = {
    "x": ((0, 1, 0), (0, 0, 1), (1, 0, 0)), "-x": ((0, 1, 0), (0, 0, -1), (-1, 0, 0)),
    "y": ((1, 0, 0), (0, 0, -1), (0, 1, 0)), "-y": ((1, 0, 0), (0, 0, 1), (0, -1, 0)),
    "z": ((1, 0, 0), (0, 1, 0), (0, 0, 1)), "-z": ((1, 0, 0), (0, -1, 0), (0, 0, -1)),
}  # fmt: skip
# Height of a storey from the floor to the ceiling. Only one unit puts a value in this range.
_STOREY_M: Final = (2.0, 4.5)
# glTF files are in metres by their standard, unless a storey is lower or higher than this.
_METRES_STOREY_M: Final = (1.8, 15.0)
# Horizontal extent of a place without a ceiling, and its height in other units than metres.
_EXTENT_M: Final = (2.0, 300.0)
_HEIGHT_M: Final = 15.0
# A storey this high in a given unit, and usual in a unit of at most a tenth, contradicts the given unit.
_ABSURD_STOREY_M: Final = 50.0
# Share of the largest level's area that a floor and a ceiling have at least.
_LEVEL: Final = 0.25
_BINS: Final = 256
_OUTLIERS: Final = 0.002  # Share of the area at either end that the extent leaves out.
# glTF's up axis holds unless another axis has a level of this many times the area.
_CLEARLY: Final = 2.0
#: Memory of the textures with their smaller copies, bytes, and the longest side, pixels.
MOST_TEXTURE: Final = 1 << 30
_LONGEST_PX: Final = 8192
_QUALITY: Final = 95
_UNSUPPORTED: Final = {
    "KHR_texture_basisu": "KTX2 textures are unsupported; convert them: "
    "gltf-transform ktxdecompress IN.glb OUT.glb",
    "EXT_meshopt_compression": "meshopt compression is unsupported; convert it: "
    "gltf-transform copy IN.glb OUT.glb",
}
_PLAIN_PX: Final = 4
_GREY: Final = (200, 200, 200)  # Without a material.


@dataclass(frozen=True)
class Scanned:
    """A scan in metres, z up.

    `untextured` is the share of the area without a picture or colours; `notes` describe decisions
    and warnings, by their name.
    """

    parts: tuple[ScanPart, ...]
    faces: tuple[PartFaces, ...]
    untextured: float
    notes: tuple[tuple[str, str], ...]


class _Paint(NamedTuple):
    """Picture and texture coordinates of a mesh, and whether they come from the scan."""

    picture: Image.Image
    uvs: NDArray[np.float32]
    textured: bool


def read_scan(source: Path, scale: float | None = None, up: str | None = None) -> Scanned:
    """Read a scan; `scale` (metres per unit) and `up` replace the detected values.

    Raises
    ------
    WorldError
        The file is not a usable mesh.
    """
    kind = scan_format(source)
    if kind is None:
        raise WorldError("unsupported; a scan is a .glb, .gltf, .obj or .ply file")
    try:
        parts, faces, untextured, notes = _parts(source, kind)
    except (OSError, SyntaxError, ValueError) as error:  # As Pillow raises them.
        raise WorldError(f"its content is damaged ({error})") from None
    axis, *axis_notes = _up_axis(faces, up, usual="y" if kind in {"glb", "gltf"} else None)
    scale_m, scale_note = _scale(parts, faces, axis, scale, metric=kind in {"glb", "gltf"})
    turn = np.array(_ROTATIONS[axis], dtype=np.float64)
    return Scanned(
        tuple(replace(part, vertices=part.vertices @ turn.T * scale_m) for part in parts),
        tuple(one.turned(turn, scale_m) for one in faces),
        untextured,
        (*axis_notes, scale_note, *notes),
    )


def _parts(
    source: Path, kind: str
) -> tuple[list[ScanPart], list[PartFaces], float, list[tuple[str, str]]]:
    """Return the parts as in the file, the untextured share of their area, and warnings."""
    meshes = list(_meshes(source, kind))
    if not meshes:
        raise WorldError(
            "it has no triangles; a scan must be a mesh (a point cloud is unsupported)"
        )
    paints = [_paint(mesh) for mesh, _ in meshes]
    divisor, notes = _shrink([paint.picture for paint in paints])
    jpegs = _Jpegs(divisor)
    faces = [one for _, one in meshes]
    parts = [
        ScanPart(*_corners(mesh, paint), jpegs.of(paint.picture), one.both)
        for (mesh, one), paint in zip(meshes, paints, strict=True)
    ]
    areas = np.array([one.areas.sum() for one in faces])
    plain = [not paint.textured for paint in paints]
    return parts, faces, float(areas[plain].sum() / areas.sum()), notes


def _meshes(source: Path, kind: str) -> Iterator[tuple[trimesh.Trimesh, PartFaces]]:
    """Yield the meshes in the coordinates of the file, without invalid and empty triangles."""
    Image.MAX_IMAGE_PIXELS = None  # The child process has a limit of memory.
    _check_extensions(source, kind)
    try:
        with source.open("rb") as file:
            resolver = trimesh.resolvers.FilePathResolver(str(source.resolve()))
            scene = trimesh.load_scene(file, file_type=kind, resolver=resolver, process=False)
    except Exception as error:  # noqa: BLE001 - trimesh raises many types for damaged files
        reason = printable(str(error).partition("\n")[0] or type(error).__name__, 200)
        raise WorldError(f"cannot be read as {kind.upper()} ({reason})") from None
    for node in scene.graph.nodes_geometry:
        transform, name = scene.graph[node]
        mesh = scene.geometry[name]
        if isinstance(mesh, trimesh.Trimesh) and len(mesh.faces):
            mesh = mesh.copy()
            mesh.apply_transform(transform)
            mesh.update_faces(np.isfinite(mesh.triangles).all(axis=(1, 2)))
            material = getattr(mesh.visual, "material", None)
            # Only glTF can hide back faces.
            both = kind not in {"glb", "gltf"} or bool(getattr(material, "doubleSided", True))
            faces = PartFaces.of(np.asarray(mesh.triangles), both=both)
            solid = faces.areas > 0
            if solid.any():
                mesh.update_faces(solid)
                yield mesh, faces.chosen(solid)


def _check_extensions(source: Path, kind: str) -> None:
    """Reject glTF extensions that cannot be read, with the remedy."""
    if kind not in {"glb", "gltf"}:
        return
    with source.open("rb") as file:
        head = file.read(20)
        length = int.from_bytes(head[12:16], "little") if head[:4] == b"glTF" else None
        text = file.read(length) if length else head + file.read()
    used: list[str] = []
    with suppress(ValueError, AttributeError):  # Damaged text is rejected by trimesh.
        used = json.loads(text).get("extensionsUsed", [])
    for name, remedy in _UNSUPPORTED.items():
        if name in used:
            raise WorldError(remedy)


def _paint(mesh: trimesh.Trimesh) -> _Paint:
    visual = mesh.visual
    if isinstance(visual, ColorVisuals) and visual.kind is not None:
        return _coloured(mesh, np.asarray(visual.vertex_colors)[mesh.faces, :3])
    material = getattr(visual, "material", None)
    image = None if material is None else _image(material)
    uvs = getattr(visual, "uv", None)
    if image is None or uvs is None:
        return _plain(mesh, _GREY if material is None else material.main_color[:3])
    factor = getattr(material, "baseColorFactor", None)
    if factor is not None and min(factor[:3]) < 255:
        white = Image.new("RGB", image.size, tuple(int(value) for value in factor[:3]))
        image = ImageChops.multiply(image, white)
    # trimesh counts v upwards.
    downwards = np.nan_to_num(np.asarray(uvs, dtype=np.float32)[mesh.faces]) * (1, -1) + (0, 1)
    return _Paint(image, downwards.astype(np.float32), textured=True)


def _image(material: Material) -> Image.Image | None:
    names = ("image", "baseColorTexture", "emissiveTexture")
    found = (getattr(material, name, None) for name in names)
    image: Image.Image | None = next((one for one in found if one is not None), None)
    if image is None or image.mode == "RGB":
        return image
    return image.convert("RGB")


def _plain(mesh: trimesh.Trimesh, colour: Sequence[int]) -> _Paint:
    picture = Image.new("RGB", (_PLAIN_PX, _PLAIN_PX), tuple(int(value) for value in colour))
    return _Paint(picture, np.full((len(mesh.faces), 3, 2), 0.5, dtype=np.float32), textured=False)


def _coloured(mesh: trimesh.Trimesh, colours: NDArray[np.uint8]) -> _Paint:
    """Paint the corner colours (n, 3, 3) of each triangle into 2 by 2 pixels.

    Linear filtering between the centres of three pixels blends the colours as a renderer with
    vertex colours does; the fourth pixel continues the plane.
    """
    count = len(mesh.faces)
    side = math.ceil(math.sqrt(count))
    row, column = np.divmod(np.arange(count), side)
    picture = np.zeros((2 * side, 2 * side, 3), dtype=np.uint8)
    first, right, below = (colours[:, k].astype(np.int16) for k in range(3))
    picture[2 * row, 2 * column] = first
    picture[2 * row, 2 * column + 1] = right
    picture[2 * row + 1, 2 * column] = below
    picture[2 * row + 1, 2 * column + 1] = np.clip(right + below - first, 0, 255)
    corner = 2 * np.stack([column, row], axis=1)[:, None]
    uvs = (corner + np.array([[0.5, 0.5], [1.5, 0.5], [0.5, 1.5]])) / (2 * side)
    return _Paint(Image.fromarray(picture), uvs.astype(np.float32), textured=True)


def _corners(
    mesh: trimesh.Trimesh, paint: _Paint
) -> tuple[NDArray[np.float64], NDArray[np.float32], NDArray[np.uint32]]:
    """Return vertices, texture coordinates and triangles, with equal corners merged."""
    index = mesh.faces.reshape(-1)
    uvs = paint.uvs.reshape(-1, 2)
    keys = np.column_stack([index.astype(np.float64), uvs])
    _, once, again = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    return mesh.vertices[index[once]], uvs[once], again.reshape(-1, 3).astype(np.uint32)


def _shrink(pictures: Sequence[Image.Image]) -> tuple[int, list[tuple[str, str]]]:
    """Return the divisor of the pictures' sides that fits the memory, and a warning if above 1."""
    distinct = {id(picture): picture for picture in pictures}.values()
    pixels = sum(picture.width * picture.height for picture in distinct)
    longest = max(max(picture.size) for picture in distinct)
    divisor = 1
    while 4 * 4 / 3 * pixels / divisor**2 > MOST_TEXTURE or longest / divisor > _LONGEST_PX:
        divisor *= 2
    if divisor == 1:
        return 1, []
    need = f"{4 * 4 / 3 * pixels / 2**30:.1f} GiB"
    return divisor, [("warning", f"textures of {need} reduced to 1/{divisor} of their sides")]


class _Jpegs:
    """Encodes each picture once."""

    def __init__(self, divisor: int) -> None:
        self._divisor = divisor
        self._done: dict[int, bytes] = {}

    def of(self, picture: Image.Image) -> bytes:
        if id(picture) not in self._done:
            self._done[id(picture)] = self._encoded(picture)
        return self._done[id(picture)]

    def _encoded(self, picture: Image.Image) -> bytes:
        width, height = (max(1, side // self._divisor) for side in picture.size)
        content = io.BytesIO()
        shown = (
            picture if self._divisor == 1 else picture.resize((width, height), Image.Resampling.BOX)
        )
        shown.save(content, "JPEG", quality=_QUALITY, subsampling=0)
        return content.getvalue()


def _up_axis(
    faces: Sequence[PartFaces], wish: str | None, usual: str | None
) -> tuple[str, *tuple[tuple[str, str], ...]]:
    """Return the up axis, by default the normal of the largest level surface, and its notes."""
    area = {axis: _largest_level(faces, axis) for axis in "xyz"}
    best = max("yz", key=lambda axis: area[axis])
    if usual is not None and area[best] < _CLEARLY * area[usual]:
        best = usual
    if wish is None:
        return best, ("up axis", f"{best} (detected; --up AXIS sets it)")
    given = ("up axis", f"{wish} (given)")
    share = area[wish[-1]] / area[best]
    if share >= 1.0:
        return wish, given
    why = f"the largest level surface along {wish[-1]} has {share:.0%} of the area along {best}"
    return wish, given, ("warning", f"{why}; if the floor is wrong, give --up {best}")


def _levels(
    faces: Sequence[PartFaces], axis: str
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the area of level surfaces by height along an axis, and the heights."""
    along = "xyz".index(axis[-1])
    sign = -1.0 if axis.startswith("-") else 1.0
    area = np.concatenate([one.areas for one in faces])
    level = np.abs(np.concatenate([one.normals[:, along] for one in faces])) > 0.9
    middle = sign * np.concatenate([one.corners[:, :, along].mean(axis=1) for one in faces])
    # Outliers do not count: a floor of two triangles has a large area, specks have a small one.
    order = np.argsort(middle)
    share = np.cumsum(area[order]) / area.sum()
    low, high = middle[order][np.searchsorted(share, (_OUTLIERS, 1 - _OUTLIERS))]
    counts, edges = np.histogram(
        np.clip(middle[level], low, high), _BINS, (low, high + 1e-9), weights=area[level]
    )
    return counts, (edges[:-1] + edges[1:]) / 2


def _largest_level(faces: Sequence[PartFaces], axis: str) -> float:
    return float(_levels(faces, axis)[0].max())


def _storey(faces: Sequence[PartFaces], axis: str) -> float | None:
    """Return the height from the lowest large level surface to the next, in units of the file."""
    counts, heights = _levels(faces, axis)
    smooth = np.convolve(np.pad(counts, 2), (0.5, 1.0, 1.0, 1.0, 0.5), mode="same")
    peaks, _ = find_peaks(smooth, height=_LEVEL * smooth.max(), distance=_BINS // 16)
    if len(peaks) < 2:
        return None
    return float(heights[min(peaks[1] - 2, _BINS - 1)] - heights[max(peaks[0] - 2, 0)])


def _scale(
    parts: Sequence[ScanPart],
    faces: Sequence[PartFaces],
    axis: str,
    wish: float | None,
    *,
    metric: bool,
) -> tuple[float, tuple[str, str]]:
    """Return the metres per unit of the file, by the height of a storey or else by the extent."""
    storey = _storey(faces, axis)
    if wish is not None:
        _check_size(faces, axis, storey, wish)
        return wish, ("unit", f"{wish:g} m (given)")
    size = np.ptp(np.concatenate([part.vertices for part in parts]), axis=0)
    up = "xyz".index(axis[-1])
    plan = np.delete(size, up)
    unit, why = _unit(storey, float(plan.max()), float(size[up]), metric=metric)
    return _UNITS[unit], ("unit", f"{_UNITS[unit]:g} m ({why})")


def _check_size(faces: Sequence[PartFaces], axis: str, storey: float | None, scale: float) -> None:
    """Raise WorldError if a place is absurdly large in a given unit: its import takes minutes."""
    size = _size(faces)
    up = "xyz".index(axis[-1])
    plan = np.delete(size, up)
    smaller = (metres for metres in _UNITS.values() if metres <= 0.1 * scale)
    absurd = (
        storey is not None
        and storey * scale > _ABSURD_STOREY_M
        and any(_STOREY_M[0] <= storey * metres <= _STOREY_M[1] for metres in smaller)
    )
    if not absurd and plan.max() * scale <= _EXTENT_M[1]:
        return
    advice = "cut it into parts"
    with suppress(WorldError):
        unit, _ = _unit(storey, float(plan.max()), float(size[up]), metric=False)
        if _UNITS[unit] < scale:
            advice = f"give --scale {_UNITS[unit]:g} ({unit}), or leave it out"
    long, wide = (plan * scale).tolist()
    storeys = "" if storey is None else f", a storey of {storey * scale:.0f} m"
    raise WorldError(
        f"--scale {scale:g}: too large, {long:.0f} x {wide:.0f} m{storeys} (maximum {_EXTENT_M[1]:g} m); {advice}"
    )


def _size(faces: Sequence[PartFaces]) -> NDArray[np.float64]:
    """Return the extent (3,) of the surfaces without outliers, in units of the file."""
    areas = np.concatenate([one.areas for one in faces])
    corners = np.concatenate([one.corners for one in faces])
    middle = corners.mean(axis=1)
    inside = np.ones(len(areas), dtype=np.bool_)
    for along in middle.T:
        order = np.argsort(along)
        share = np.cumsum(areas[order]) / areas.sum()
        low, high = along[order][np.searchsorted(share, (_OUTLIERS, 1 - _OUTLIERS))]
        inside &= (along >= low) & (along <= high)
    return np.asarray(np.ptp(corners[inside].reshape(-1, 3), axis=0))


def _unit(storey: float | None, extent: float, height: float, *, metric: bool) -> tuple[str, str]:
    """Return the unit of a scan by its sizes in that unit, and the reason."""
    detected = "detected; --scale METRES sets it"
    if storey is not None:
        if metric and _METRES_STOREY_M[0] <= storey <= _METRES_STOREY_M[1]:
            return "m", "as glTF defines; --scale METRES sets it"
        for unit, metres in _UNITS.items():
            if _STOREY_M[0] <= storey * metres <= _STOREY_M[1]:
                return unit, f"{detected}: a storey of {storey * metres:.1f} m"
    for unit in ("m", "cm", "mm"):
        low = unit == "m" or height * _UNITS[unit] <= _HEIGHT_M
        if low and _EXTENT_M[0] <= extent * _UNITS[unit] <= _EXTENT_M[1]:
            return unit, "assumed from the extent; --scale METRES sets it"
    raise WorldError(
        f"its extent of {extent:g} fits no unit; give --scale METRES, the length of a unit of the file"
    )

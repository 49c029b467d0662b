"""The mesh file of a scan: textured triangles as a NumPy archive beside the world file."""

import zipfile
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import cv2
import numpy as np
from numpy.typing import NDArray

from services.simulator.world.place import WorldError


@dataclass(frozen=True, eq=False)
class ScanPart:
    """Triangles of one picture, metres, z up.

    Attributes
    ----------
    vertices : array of shape (n, 3)
    uvs : array of shape (n, 2)
        Texture coordinates, v downwards.
    triangles : array of shape (m, 3)
        Indices of vertices, anticlockwise seen from outside.
    jpeg : bytes
        Picture.
    both : bool
        Whether the back faces are visible.
    """

    vertices: NDArray[np.float64]
    uvs: NDArray[np.float32]
    triangles: NDArray[np.uint32]
    jpeg: bytes
    both: bool = True


def write_parts(file: IO[bytes], parts: Iterable[ScanPart]) -> None:
    """Write the parts; equal pictures are stored once."""
    pictures: dict[bytes, int] = {}
    arrays: dict[str, NDArray[np.generic]] = {}
    for number, part in enumerate(parts):
        picture = pictures.setdefault(part.jpeg, len(pictures))
        arrays[f"vertices_{number}"] = part.vertices.astype(np.float32)
        arrays[f"uvs_{number}"] = part.uvs
        arrays[f"triangles_{number}"] = part.triangles
        arrays[f"of_{number}"] = np.array([picture, part.both])
    for jpeg, picture in pictures.items():
        arrays[f"picture_{picture}"] = np.frombuffer(jpeg, dtype=np.uint8)
    np.savez(file, **arrays)  # type: ignore[arg-type]


def read_parts(path: Path) -> list[tuple[ScanPart, NDArray[np.uint8]]]:
    """Read the parts, each with its picture (h, w, 3) RGB; parts share equal pictures.

    Raises
    ------
    WorldError
        The file is missing or damaged.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            count = sum(name.startswith("vertices_") for name in file.files)
            jpegs = {name: file[name] for name in file.files if name.startswith("picture_")}
            pictures = {name: _decoded(jpeg) for name, jpeg in jpegs.items()}
            return [_part(file, number, pictures) for number in range(count)]
    except FileNotFoundError:
        raise WorldError(f"{path}: not found; a scan needs it beside its world file") from None
    except (OSError, ValueError, KeyError, zipfile.BadZipFile, cv2.error) as error:
        raise WorldError(f"{path}: damaged ({error}); import the scan again") from None


def _decoded(jpeg: NDArray[np.uint8]) -> NDArray[np.uint8]:
    image = cv2.imdecode(jpeg, cv2.IMREAD_COLOR)
    if image is None:
        raise ValueError("a picture is invalid")
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), dtype=np.uint8)


def _part(
    file: "np.lib.npyio.NpzFile", number: int, pictures: dict[str, NDArray[np.uint8]]
) -> tuple[ScanPart, NDArray[np.uint8]]:
    vertices, uvs, triangles = (
        file[f"{name}_{number}"] for name in ("vertices", "uvs", "triangles")
    )
    picture, both = file[f"of_{number}"].tolist()
    fits = vertices.shape[1:] == (3,) and uvs.shape == (len(vertices), 2)
    # The renderer does not check indices.
    if not fits or triangles.shape[1:] != (3,) or triangles.max(initial=0) >= len(vertices):
        raise ValueError(f"part {number} is invalid")
    part = ScanPart(vertices, uvs, triangles.astype(np.uint32), b"", bool(both))
    return part, pictures[f"picture_{picture}"]

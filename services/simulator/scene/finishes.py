"""What meshes wear: a material or the picture of a face, perhaps in another colour."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from typing import TYPE_CHECKING, cast, get_args

import numpy as np

from services.simulator.scene.meshes import Mesh, merge
from services.simulator.scene.noise import as_picture
from services.simulator.scene.pictures import Face, paint_face
from services.simulator.scene.surfaces import Surface
from services.simulator.scene.textures import Material, paint

if TYPE_CHECKING:
    from collections.abc import Iterable

    from numpy.typing import NDArray

    from services.simulator.world.place import Rgb


@dataclass(frozen=True)
class Finish:
    """What a mesh wears: a material or a picture of a face, perhaps in another colour; the variant is a face's."""

    wears: Material | Face
    colour: Rgb | None = None
    variant: int = 0

    def picture(self) -> NDArray[np.uint8]:
        """Return it painted."""
        if self.wears in get_args(Face):
            return paint_face(cast("Face", self.wears), self.variant, self.colour)
        plain = paint(cast("Material", self.wears))
        if self.colour is None:
            return plain
        return as_picture(plain * (np.array(self.colour) / plain.mean(axis=(0, 1))))


Piece = tuple[Finish, Mesh]


def surfaces(pieces: Iterable[Piece], *, glows: bool = False) -> tuple[Surface, ...]:
    """Return one surface for each finish."""
    meshes: dict[Finish, list[Mesh]] = defaultdict(list)
    for finish, mesh in pieces:
        meshes[finish].append(mesh)
    return tuple(Surface(merge(group), finish.picture(), glows) for finish, group in meshes.items())

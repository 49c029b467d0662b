"""What a scene is made of: lights, and surfaces that wear a material or the picture of a face."""

from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

from services.kit.going_on import each
from services.simulator.scene.facades import paint_facade
from services.simulator.scene.faces import FACES, paint_face
from services.simulator.scene.meshes import Mesh, merge
from services.simulator.scene.textures import Picture, paint, tinted
from services.simulator.world.place import Rgb
from services.simulator.world.terrain import Facade

Vector = tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class Surface:
    """A mesh and the picture that it wears, (h, w, 3) uint8 RGB; `glows` for what needs no light."""

    mesh: Mesh
    picture: Picture
    glows: bool = False


class SceneSurfaces(NamedTuple):
    """Everything to be drawn."""

    ambient: Vector  # The light from everywhere.
    lights: tuple[
        tuple[Vector, Vector], ...
    ]  # Those far away: the direction that each goes, and its colour.
    still: tuple[Surface, ...]  # What never moves.
    victim: tuple[Surface, ...]  # The victim, about its own origin, x forward.
    decoys: tuple[tuple[Surface, ...], ...]  # What can lie in its place instead, of its size.
    robot: tuple[
        Surface, ...
    ] = ()  # The robot, about its own origin, x forward; nothing where no camera sees it.
    sky: Surface | None = None  # The dome that goes with the camera; None under a ceiling.


class Finish(NamedTuple):
    """What a mesh wears: a material or a face by name, or a façade; `variant` is that of a face, or a façade's part."""

    wears: str | Facade
    colour: Rgb | None = None
    variant: int = 0

    def picture(self) -> Picture:
        """Return it painted."""
        if isinstance(self.wears, Facade):
            return paint_facade(self.wears)[self.variant]
        if self.wears in FACES:
            return paint_face(self.wears, self.variant, self.colour)
        plain = paint(self.wears)
        return plain if self.colour is None else tinted(plain, self.colour)


Piece = tuple[Finish, Mesh]


def surfaces(pieces: Iterable[Piece]) -> tuple[Surface, ...]:
    """Return one surface for each finish; those of a façade follow each other, and windows of rooms glow."""
    meshes: dict[Finish, list[Mesh]] = defaultdict(list)
    for finish, mesh in pieces:
        meshes[finish].append(mesh)
    return tuple(
        Surface(merge(group), finish.picture(), glows=finish.wears == "window")
        for finish, group in each(list(meshes.items()))
    )

"""Elements of a scene: lights, and surfaces with a material or the picture of a face."""

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
    """A mesh with a picture, (h, w, 3) uint8 RGB; `glows` disables lighting.

    `tint` multiplies the colours of a picture that glows.
    """

    mesh: Mesh
    picture: Picture
    glows: bool = False
    tint: Vector = (1.0, 1.0, 1.0)


class Tile(NamedTuple):
    """A part of a large scene, drawn only in view, and from afar with fewer triangles."""

    near: Surface
    far: Surface
    near_m: float  # Distance from which the far surface is drawn.


class SceneSurfaces(NamedTuple):
    """All surfaces and lights of a scene."""

    ambient: Vector  # Ambient light.
    # Directional lights: direction and colour.
    lights: tuple[tuple[Vector, Vector], ...]
    still: tuple[Surface, ...]  # Static surfaces.
    victim: tuple[Surface, ...]  # The victim about its own origin, x forward.
    decoys: tuple[tuple[Surface, ...], ...]  # Things of the victim's size that can replace it.
    # The robot about its own origin, x forward; empty without an overhead camera.
    robot: tuple[Surface, ...] = ()
    sky: Surface | None = None  # Dome that moves with the camera; None under a ceiling.
    tiles: tuple[Tile, ...] = ()  # Further static surfaces.


class Finish(NamedTuple):
    """Finish of a mesh: a material, a face with its variant, or a façade with its part."""

    wears: str | Facade
    colour: Rgb | None = None
    variant: int = 0

    def picture(self) -> Picture:
        """Paint the finish."""
        if isinstance(self.wears, Facade):
            return paint_facade(self.wears)[self.variant]
        if self.wears in FACES:
            return paint_face(self.wears, self.variant, self.colour)
        plain = paint(self.wears)
        return plain if self.colour is None else tinted(plain, self.colour)


Piece = tuple[Finish, Mesh]


def surfaces(pieces: Iterable[Piece]) -> tuple[Surface, ...]:
    """Merge the pieces of each finish into one surface; windows of rooms glow."""
    meshes: dict[Finish, list[Mesh]] = defaultdict(list)
    for finish, mesh in pieces:
        meshes[finish].append(mesh)
    return tuple(
        Surface(merge(group), finish.picture(), glows=finish.wears == "window")
        for finish, group in each(list(meshes.items()))
    )

"""Build meshes, pictures and lights of a world for any renderer, with its sky and trees."""

import zlib
from collections.abc import Iterable, Iterator
from typing import Final

import numpy as np
from shapely import Point, Polygon

from services.simulator.scene import bodies, room, scan
from services.simulator.scene.buildings import barriers, buildings
from services.simulator.scene.ground import cast_shade, ground
from services.simulator.scene.meshes import Mesh, ball, tube
from services.simulator.scene.sky import outdoor_light, sky_dome
from services.simulator.scene.surfaces import Finish, Piece, SceneSurfaces, surfaces
from services.simulator.variation import Daylight
from services.simulator.world.place import World
from services.simulator.world.room import Room
from services.simulator.world.scan import ScannedPlace
from services.simulator.world.terrain import Terrain, Tree, TreeKind

#: For each kind: radius of the crown, and height of its lower end, as fractions of the tree height.
_CROWN: Final[dict[TreeKind, tuple[float, float]]] = {
    "round": (0.34, 0.28),
    "tall": (0.2, 0.22),
    "conifer": (0.22, 0.12),
}
_LEAVES: Final[dict[TreeKind, str]] = {
    "round": "leaves",
    "tall": "dark_leaves",
    "conifer": "needles",
}
# Leaves hide the small number of faces; a town has thousands of trees.
_DETAIL: Final = 5
_SMALL_DETAIL: Final = 3
_TIERS: Final = 4


def build_scene(world: World, light: Daylight) -> SceneSurfaces:
    """Build the meshes, pictures and lights of a world; takes seconds."""
    terrain = world.place
    if isinstance(terrain, Room):
        return room.build(terrain, light)
    if isinstance(terrain, ScannedPlace):
        return scan.build(terrain, light)
    if not isinstance(terrain, Terrain):
        raise TypeError(f"unsupported place: {type(terrain).__name__}")
    # A weak sun casts no visible shadows.
    shade = (
        cast_shade(terrain, light.direction, crowns(terrain.trees))
        if max(light.sun) > 0.5
        else Polygon()
    )
    # Early draws occlude later draws; the ground lies behind everything, so it comes last.
    things = [*buildings(terrain.buildings), *barriers(terrain.barriers), *trees(terrain.trees)]
    return SceneSurfaces(
        *outdoor_light(light),
        still=(*surfaces(things), *surfaces(ground(terrain, shade))),
        victim=surfaces(bodies.body("person")),
        decoys=tuple(surfaces(bodies.body(name)) for name in bodies.OUTDOOR_DECOYS),
        sky=sky_dome(light),
    )


def trees(items: Iterable[Tree]) -> Iterator[Piece]:
    """Yield trunks and crowns."""
    for tree in items:
        rng = np.random.default_rng(zlib.crc32(f"{tree.x:.1f} {tree.y:.1f}".encode()))
        base = (tree.x, tree.y, 0.0)
        neck = (tree.x, tree.y, tree.height_m * 0.6)
        yield Finish("bark"), tube(base, neck, (tree.trunk_radius_m, tree.trunk_radius_m * 0.6), 6)
        crown = _tiers(tree) if tree.kind == "conifer" else _crown(tree, rng)
        yield from ((Finish(_LEAVES[tree.kind]), mesh) for mesh in crown)


def crowns(items: Iterable[Tree]) -> list[tuple[Polygon, float, float]]:
    """Return the outline of each crown from above, with the heights of its lower and upper end."""
    found = []
    for tree in items:
        radius, low = (fraction * tree.height_m for fraction in _CROWN[tree.kind])
        middle = (low + tree.height_m) / 2
        disc = Point(tree.x, tree.y).buffer(radius * 0.9, quad_segs=4)
        found.append((disc, middle - (middle - low) * 0.4, middle + (tree.height_m - middle) * 0.4))
    return found


def _crown(tree: Tree, rng: np.random.Generator) -> Iterator[Mesh]:
    """Yield a large ball of leaves with four small ones around it."""
    radius, low = (fraction * tree.height_m for fraction in _CROWN[tree.kind])
    middle = (low + tree.height_m) / 2
    half = (tree.height_m - low) / 2
    yield ball((tree.x, tree.y, middle), (radius * 0.8, radius * 0.8, half * 0.95), _DETAIL)
    for angle in np.linspace(0, 2 * np.pi, 4, endpoint=False) + rng.uniform(0, 1.5):
        out = radius * rng.uniform(0.35, 0.5)
        size = radius * rng.uniform(0.5, 0.65)
        centre = (
            tree.x + out * np.cos(angle),
            tree.y + out * np.sin(angle),
            middle + half * rng.uniform(-0.45, 0.35),
        )
        yield ball(centre, (size, size, min(size, half * 0.6) * 0.9), _SMALL_DETAIL)


def _tiers(tree: Tree) -> Iterator[Mesh]:
    radius, low = (fraction * tree.height_m for fraction in _CROWN["conifer"])
    for step in np.arange(_TIERS) / _TIERS:
        foot = low + (tree.height_m - low) * step * 0.8
        tip = low + (tree.height_m - low) * min(1.0, step + 0.4)
        yield tube(
            (tree.x, tree.y, foot), (tree.x, tree.y, tip), (radius * (1 - 0.8 * step), 0.0), 10
        )

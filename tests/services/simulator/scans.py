"""Scans for tests: our laboratory as a phone would export it, with any unit, axis and hole."""

import math
from functools import cache
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray
from PIL import Image
from trimesh.visual import ColorVisuals, TextureVisuals
from trimesh.visual.material import PBRMaterial, SimpleMaterial

from services.simulator.scene.build import build_scene
from services.simulator.scene.surfaces import Surface
from services.simulator.variation import DAY
from services.simulator.world import load_world

#: Extent of the laboratory, metres.
SIZE_M = (8.0, 6.0)
#: Small pictures: PNG compresses those of 512 pixels in two seconds a scan.
_LARGEST_PX = 256
_Y_UP = np.array([[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1.0]])


def laboratory(*, unit_m: float = 1.0, y_up: bool = True, colours: bool = False) -> trimesh.Scene:
    """Return the included indoor world as meshes with pictures, or with colours of vertices."""
    transform = (_Y_UP if y_up else np.eye(4)) * np.array([1, 1, 1, 0.0])[:, None] / unit_m
    transform[3, 3] = 1.0
    scene = trimesh.Scene()
    for number, surface in enumerate(_surfaces()):
        mesh = surface.mesh
        visual = _colours(surface) if colours else _pictures(surface, y_up=y_up)
        shape = trimesh.Trimesh(mesh.vertices, mesh.triangles, visual=visual, process=False)
        scene.add_geometry(shape, node_name=f"part{number}", transform=transform)
    return scene


@cache
def _surfaces() -> list[Surface]:
    return list(build_scene(load_world("indoor"), DAY.light).still)


def _pictures(surface: Surface, *, y_up: bool) -> TextureVisuals:
    whole = Image.fromarray(surface.picture)
    picture = whole.resize([min(side, _LARGEST_PX) for side in whole.size])
    material = (
        PBRMaterial(baseColorTexture=picture, doubleSided=False)
        if y_up
        else SimpleMaterial(image=picture)
    )
    return TextureVisuals(uv=surface.mesh.uvs * (1, -1) + (0, 1), material=material)


def _colours(surface: Surface) -> ColorVisuals:
    height, width, _ = surface.picture.shape
    x, y = (surface.mesh.uvs % 1.0 * (width - 1, height - 1)).astype(int).T
    return ColorVisuals(vertex_colors=surface.picture[y, x])


def without_floor(scene: trimesh.Scene, x_m: float, y_m: float, radius_m: float) -> trimesh.Scene:
    """Cut a hole into the floor: the floor's two triangles become small ones first."""
    for name, mesh in scene.geometry.items():
        if mesh.extents[2] < 1e-6 and mesh.bounds[0, 2] < 1e-6 and len(mesh.faces) == 2:
            vertices, faces, uvs = _subdivided(mesh)
            away = np.hypot(vertices[faces][..., 0] - x_m, vertices[faces][..., 1] - y_m)
            visual = TextureVisuals(uv=uvs, material=mesh.visual.material)
            kept = faces[away.min(axis=1) > radius_m]
            scene.geometry[name] = trimesh.Trimesh(vertices, kept, visual=visual, process=False)
    return scene


def _subdivided(
    mesh: trimesh.Trimesh,
) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.float64]]:
    points = np.column_stack([mesh.vertices, mesh.visual.uv])
    faces = mesh.faces
    while np.ptp(points[faces][..., 0], axis=1).max() > 0.2:
        points, faces = trimesh.remesh.subdivide(points, faces)
    return points[:, :3], faces, points[:, 3:]


def two_storeys(folder: Path) -> Path:
    """Write a house of two rooms above each other, without a stair, the upper one larger."""
    rooms = [_closed_room(5.0, 0.0), _closed_room(6.0, 3.0)]
    path = folder / "house.ply"
    trimesh.util.concatenate(rooms).export(path)
    return path


def _closed_room(side_m: float, low_m: float, high_m: float = 2.6) -> trimesh.Trimesh:
    """Return a room seen from inside: the walls of a box, turned inside out."""
    room = trimesh.creation.box((side_m, side_m, high_m))
    room.apply_translation((0.0, 0.0, low_m + high_m / 2))
    room.invert()
    return room


def hilly(folder: Path) -> Path:
    """Write an outdoor slope of 10 %, with a wall at its top."""
    x, y = np.meshgrid(np.linspace(0, 20, 41), np.linspace(0, 20, 41), indexing="ij")
    ground = np.stack([x, y, 0.1 * x + 0.02 * np.sin(3 * y)], axis=-1).reshape(-1, 3)
    index = np.arange(41 * 41).reshape(41, 41)
    first = index[:-1, :-1]
    across = index[1:, 1:]
    halves = ((first, index[1:, :-1], across), (first, across, index[:-1, 1:]))
    faces = np.concatenate([np.stack(half, axis=-1).reshape(-1, 3) for half in halves])
    wall = trimesh.creation.box((0.3, 16.0, 2.5))
    wall.apply_translation((10.0, 8.0, 1.0 + 1.25))
    path = folder / "hill.ply"
    trimesh.util.concatenate([trimesh.Trimesh(ground, faces, process=False), wall]).export(path)
    return path


def slope_deg(points: NDArray[np.float32]) -> float:
    """Return the slope of the plane through points (n, 3), degrees."""
    plane = np.column_stack([points[:, :2], np.ones(len(points))])
    x, y, _ = np.linalg.lstsq(plane, points[:, 2], rcond=None)[0]
    return math.degrees(math.atan(math.hypot(x, y)))

"""Scene of a scan: its pictures unlit, in tiles, with the victim and the sky."""

from collections.abc import Iterator
from typing import Final

import numpy as np
import shapely
from numpy.typing import NDArray

from services.simulator.scanning.mesh_file import ScanPart, read_parts
from services.simulator.scene import bodies
from services.simulator.scene.meshes import Mesh, make
from services.simulator.scene.room import indoor_light
from services.simulator.scene.sky import outdoor_light, sky_dome
from services.simulator.scene.surfaces import SceneSurfaces, Surface, Tile, Vector, surfaces
from services.simulator.sensors.camera import FOCAL
from services.simulator.variation import DAY, Daylight
from services.simulator.world.scan import ScannedPlace

# Side of the tiles, in clearances of the place.
_TILE: Final = 12.0
# Distance from which a tile has fewer triangles, and the cell in which their vertices merge, in
# sides of a tile: two pixels of an image of this width.
_NEAR: Final = 1.5
_IMAGE_PX: Final = 320
_COARSE: Final = _NEAR * 2 / (FOCAL * _IMAGE_PX)
# Number of chart cells along a picture: two points of one cell and one chart are near each other.
_CHARTS: Final = 64
# Half the width of a door: the floor farther from walls falls apart into rooms.
_HALF_DOOR_M: Final = 0.55
# Standard deviation of the brightness of each room's lamps and of their colour, of light that
# differs from the day of the scan.
_LAMPS: Final = 0.15
_COLOUR: Final = 0.06
_GAMMA: Final = 2.2  # Gamma of the encoded pictures, as in the shader.


def build(scan: ScannedPlace, light: Daylight) -> SceneSurfaces:
    """Build the tiles of a scan; raises WorldError for a damaged mesh file."""
    victim, decoys = (
        ("nao", bodies.INDOOR_DECOYS) if scan.robot.indoor else ("person", bodies.OUTDOOR_DECOYS)
    )
    return SceneSurfaces(
        *(outdoor_light(light) if scan.sky else indoor_light(light)),
        still=(),
        victim=surfaces(bodies.body(victim)),
        decoys=tuple(surfaces(bodies.body(name)) for name in decoys),
        sky=sky_dome(light) if scan.sky else None,
        tiles=tuple(_tiles(scan, light)),
    )


def _tiles(scan: ScannedPlace, light: Daylight) -> Iterator[Tile]:
    """Cut the parts into square tiles, with the light of the room that each lies in."""
    rooms = _Rooms(scan, light)
    side_m = _TILE * scan.scale.clearance_m
    for part, picture in read_parts(scan.mesh):
        middles = part.vertices[part.triangles].mean(axis=1)
        tiles, of = np.unique(np.floor(middles[:, :2] / side_m), axis=0, return_inverse=True)
        for number, tile in enumerate(tiles):
            tint = rooms.tint((tile + 0.5) * side_m)
            mesh = _mesh(part, of.ravel() == number)
            near, far = (
                Surface(one, picture, glows=True, tint=tint)
                for one in (mesh, _coarse(mesh, _COARSE * side_m))
            )
            yield Tile(near, far, _NEAR * side_m)


def _mesh(part: ScanPart, which: NDArray[np.bool_]) -> Mesh:
    used, corners = np.unique(part.triangles[which], return_inverse=True)
    vertices = part.vertices[used]
    triangles = corners.reshape(-1, 3)
    if part.both:  # The renderer culls back faces.
        triangles = np.concatenate([triangles, triangles[:, ::-1]])
    # Unlit surfaces need no normals.
    return make(vertices, np.zeros_like(vertices), part.uvs[used], triangles)


def _coarse(mesh: Mesh, cell_m: float) -> Mesh:
    """Merge the vertices in each cell (Rossignac and Borrel 1993).

    Charts of the picture keep separate texture coordinates at a common position, so that no gap
    opens between them.
    """
    cell = _numbers(np.floor(mesh.vertices / cell_m))
    chart = _numbers(np.column_stack([cell, np.floor(mesh.uvs * _CHARTS)]))
    _, first = np.unique(chart, return_index=True)
    vertices = _means(mesh.vertices, cell)[cell[first]]
    triangles = chart[mesh.triangles]
    corners = cell[mesh.triangles]
    solid = (corners != np.roll(corners, 1, axis=1)).all(axis=1)
    if not solid.any():  # A fragment smaller than a cell.
        return mesh
    return make(vertices, np.zeros_like(vertices), _means(mesh.uvs, chart), triangles[solid])


def _numbers(rows: NDArray[np.floating]) -> NDArray[np.int64]:
    """Return a number for each row (n, k) of whole numbers, the same for equal rows."""
    whole = (rows - rows.min(axis=0)).astype(np.int64)
    codes = np.ravel_multi_index(whole.T, tuple(whole.max(axis=0) + 1))
    return np.unique(codes, return_inverse=True)[1]


def _means(values: NDArray[np.float32], group: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the mean value (m, k) of each group."""
    sums = [np.bincount(group, weights=column) for column in values.T]
    return np.column_stack(sums) / np.bincount(group)[:, None]


class _Rooms:
    """Light of each room, relative to the light of the scan."""

    def __init__(self, scan: ScannedPlace, light: Daylight) -> None:
        cores = shapely.get_parts(scan.floor.footprint.buffer(-_HALF_DOOR_M))
        self._tree = shapely.STRtree(cores if len(cores) else [scan.floor.footprint])
        count = len(self._tree.geometries)
        gain = np.divide(_brightness(light, scan), _brightness(DAY.light, scan))
        self._gains = np.broadcast_to(gain, (count, 3))
        if not scan.sky and light != DAY.light:
            rng = np.random.default_rng(light.clouds_seed)
            lamps = np.exp(_LAMPS * rng.standard_normal((count, 1)))
            warmth = _COLOUR * rng.standard_normal((count, 1)) * (1.0, 0.0, -1.0)
            self._gains = self._gains * lamps * np.exp(warmth)

    def tint(self, xy: NDArray[np.float64]) -> Vector:
        """Return the factors of the gamma-encoded colours at a place (2,)."""
        room = int(self._tree.nearest(shapely.Point(xy)))
        red, green, blue = (self._gains[room] ** (1 / _GAMMA)).tolist()
        return red, green, blue


def _brightness(light: Daylight, scan: ScannedPlace) -> Vector:
    """Return the light on a level surface."""
    if not scan.sky:
        return light.lamps
    sun = np.array(light.sun) * -light.direction[2] / np.pi
    red, green, blue = (np.array(light.sky) + sun + np.array(light.fill) * 0.2 / np.pi).tolist()
    return red, green, blue

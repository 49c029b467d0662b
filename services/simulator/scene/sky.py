"""Sky dome and daylight; clouds differ by seed, the skyline is constant."""

import math
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from services.simulator.scene.meshes import ball, make
from services.simulator.scene.surfaces import Surface, Vector
from services.simulator.scene.textures import Picture, as_picture, layered, noise
from services.simulator.variation import Daylight

_RADIUS_M: Final = 900.0
_DOME_DETAIL: Final = 24
_SEED: Final = 7
_SKY_SHAPE: Final = (1024, 4096)
# Elevation at the top and the bottom of the picture, degrees.
_TOP_DEG: Final = 90.0
_BOTTOM_DEG: Final = -10.0
_FAIR_HORIZON: Final = np.array([206.0, 218.0, 228.0])
_CLOUDS: Final = np.array([246.0, 246.0, 244.0])
_HILLS: Final = np.array([122.0, 134.0, 138.0])
_TREES: Final = np.array([86.0, 104.0, 78.0])


def outdoor_light(light: Daylight) -> tuple[Vector, tuple[tuple[Vector, Vector], ...]]:
    """Return the ambient light, and the directions and colours of the lights."""
    # The sky opposite the sun is brighter, so that shaded walls keep their shape.
    east, north = -0.9 * np.array(light.direction[:2]) / max(math.hypot(*light.direction[:2]), 1e-9)
    opposite = (float(east), float(north), -0.2)
    return light.sky, ((light.direction, light.sun), (opposite, light.fill))


def sky_dome(light: Daylight) -> Surface:
    """Return the sky dome; it moves with the camera."""
    dome = ball((0, 0, 0), (1, 1, 1), _DOME_DETAIL)
    elevation = np.degrees(np.arcsin(np.clip(dome.vertices[:, 2], -1, 1)))
    uvs = np.column_stack(
        [
            dome.uvs[:, 0] / 2,
            np.clip((_TOP_DEG - elevation) / (_TOP_DEG - _BOTTOM_DEG), 0.002, 0.998),
        ]
    )
    inside = make(dome.vertices * _RADIUS_M, dome.normals, uvs, dome.triangles).flipped()
    return Surface(inside, _paint_sky(_SEED, light), glows=True)


@lru_cache(maxsize=2)
def _paint_sky(seed: int, light: Daylight) -> Picture:
    """Paint the panorama (1024, 4096, 3), seamless to the sides, from 90 degrees up to 10 below."""
    rng = np.random.default_rng(seed)
    clouds = np.random.default_rng([seed, light.clouds_seed])
    elevation = np.linspace(_TOP_DEG, _BOTTOM_DEG, _SKY_SHAPE[0])[:, None]
    up = np.clip(elevation / 90.0, 0, 1)
    horizon = np.array(light.horizon)
    zenith = np.array(light.zenith)
    sky = horizon + (zenith - horizon) * up**0.55
    cloud = np.clip(light.clouds * _clouds(clouds, elevation), 0, 1)
    # Clouds and distant land have the brightness and colour of the horizon.
    tint = horizon / _FAIR_HORIZON
    hills = _skyline(rng, 3.2, 1.1, 90.0)
    lit = 1.0 + 0.10 * noise(rng, _SKY_SHAPE, 5.0)
    trees = _skyline(rng, 1.2, 0.45, 12.0)
    picture = np.empty((*_SKY_SHAPE, 3), dtype=np.uint8)
    # Row by row: the whole picture as floats takes 100 MB and twice the time.
    for row, level in enumerate(elevation):
        covered = cloud[row, :, None]
        colours = sky[row] * (1 - covered) + _CLOUDS * tint * covered
        colours[level < hills] = _HILLS * tint
        wooded = level < trees
        colours[wooded] = _TREES * tint * lit[row, wooded, None]
        picture[row] = as_picture(colours)
    return picture


def _clouds(rng: np.random.Generator, elevation: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the cloud cover, 0 to 1; clouds are flat and dense near the horizon."""
    billows = 0.7 * noise(rng, _SKY_SHAPE, (60.0, 200.0)) + 0.45 * layered(
        rng, _SKY_SHAPE, (14.0, 40.0)
    )
    amount = np.clip((billows - 0.35) * 0.9, 0, 1)
    return np.asarray(amount * np.clip(elevation / 12.0, 0, 1) * 0.9, dtype=np.float64)


def _skyline(
    rng: np.random.Generator, mean_deg: float, spread_deg: float, grain_px: float
) -> NDArray[np.float64]:
    """Return the elevation (width,) of a rugged skyline, degrees."""
    line = noise(rng, (1, _SKY_SHAPE[1]), (1.0, grain_px)) + 0.3 * noise(
        rng, (1, _SKY_SHAPE[1]), (1.0, 4.0)
    )
    return np.asarray(mean_deg + spread_deg * line[0], dtype=np.float64)

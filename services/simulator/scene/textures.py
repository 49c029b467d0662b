"""Seamless, reproducible pictures of materials, (h, w, 3) uint8 RGB."""

import zlib
from collections.abc import Callable
from functools import lru_cache
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from services.simulator.tables import table
from services.simulator.world.place import Rgb

Picture = NDArray[np.uint8]
Painter = Callable[..., Picture]
_MATERIALS: Final = table("materials", dict[str, dict[str, Any]])
_SHAPE: Final = (512, 512)
_PLAIN_SHAPE: Final = (64, 64)


def noise(
    rng: np.random.Generator, shape: tuple[int, int], grain_px: float | tuple[float, float]
) -> NDArray[np.float64]:
    """Return smooth seamless noise, mean 0, standard deviation 1, with blobs of `grain_px`."""
    down, across = grain_px if isinstance(grain_px, tuple) else (grain_px, grain_px)
    frequency_down = np.fft.fftfreq(shape[0])[:, None]
    frequency_across = np.fft.rfftfreq(shape[1])
    # Higher frequencies pass by less than 1e-15; omitting them halves the time.
    frequency_across = frequency_across[frequency_across * across < 4.2]
    keep = np.exp(-2.0 * ((frequency_down * down) ** 2 + (frequency_across * across) ** 2))
    # A product of spectra is a circular convolution, so the edges match.
    spectrum = (
        np.fft.fft(np.fft.rfft(rng.standard_normal(shape))[:, : frequency_across.size], axis=0)
        * keep
    )
    smooth = np.fft.irfft(np.fft.ifft(spectrum, axis=0), shape[1])
    smooth -= smooth.mean()
    return np.asarray(smooth / max(float(smooth.std()), 1e-9), dtype=np.float64)


def layered(
    rng: np.random.Generator, shape: tuple[int, int], grains_px: ArrayLike
) -> NDArray[np.float64]:
    """Sum noises of several grains, coarse grains weighted more; standard deviation about 1."""
    grains = np.atleast_1d(np.asarray(grains_px, dtype=np.float64))
    weights = np.sqrt(grains / grains.sum())
    return np.asarray(
        sum(
            weight * noise(rng, shape, float(grain))
            for weight, grain in zip(weights, grains, strict=True)
        ),
        dtype=np.float64,
    )


def coloured(colour: ArrayLike, shade: NDArray[np.float64]) -> Picture:
    """Scale an RGB colour by the factors `shade` (h, w) into a picture (h, w, 3)."""
    return as_picture(np.asarray(colour, dtype=np.float64) * shade[..., None])


def tinted(picture: Picture, colour: ArrayLike) -> Picture:
    """Recolour a picture (h, w, 3): its mean becomes the RGB colour, shading stays."""
    grey = picture.astype(np.float64).mean(axis=2)
    return coloured(colour, grey / max(float(grey.mean()), 1.0))


def as_picture(values: NDArray[np.float64]) -> Picture:
    """Clip values to 0 to 255 and convert them to a picture."""
    return np.clip(values, 0, 255).astype(np.uint8)


@lru_cache(maxsize=64)
def paint(material: str) -> Picture:
    """Paint a material of the table `materials`, (h, w, 3) uint8 RGB; h and w are powers of two."""
    how = dict(_MATERIALS[material])
    # A separate seed for each material, so that a new material changes no other.
    return _PAINTERS[how.pop("painter")](
        np.random.default_rng(zlib.crc32(material.encode())), **how
    )


def _rough(
    rng: np.random.Generator, colour: Rgb, layers: list[tuple[float, float, float]], cracks: int = 0
) -> Picture:
    """Paint layers of noise (blob height, blob width in pixels, strength), and cracks."""
    shades = (contrast * noise(rng, _SHAPE, (down, across)) for down, across, contrast in layers)
    picture = coloured(colour, 1.0 + sum(shades, np.zeros(_SHAPE)))
    for _ in range(cracks):
        steps = rng.normal((0.0, 9.0), (2.5, 3.0), (24, 2)).cumsum(axis=0) + rng.integers(
            60, 300, 2
        )
        cv2.polylines(picture, [steps.astype(np.int32)], False, (66, 66, 70), 3, cv2.LINE_AA)
    return picture


def _plain(_rng: np.random.Generator, colour: Rgb) -> Picture:
    return np.full((*_PLAIN_SHAPE, 3), colour, dtype=np.uint8)


def _grass(rng: np.random.Generator, colour: Rgb) -> Picture:
    shade = 1.0 + 0.16 * noise(rng, _SHAPE, (5.0, 1.5)) + 0.10 * noise(rng, _SHAPE, 24.0)
    dry = np.clip(0.5 + 0.35 * noise(rng, _SHAPE, 70.0), 0, 1)[..., None]
    return as_picture(
        (np.array(colour) * (1 - 0.25 * dry) + np.array([60, 48, 12]) * 0.5 * dry)
        * shade[..., None]
    )


def _paving(
    rng: np.random.Generator,
    colour: Rgb,
    grid: tuple[int, int],
    joint_px: int,
    *,
    running: bool = True,
    contrast: float = 0.05,
    upright: bool = False,
) -> Picture:
    """Paint slabs with dark joints; `running` shifts every other row, `upright` rotates all."""
    rows, columns = grid
    height = _SHAPE[0] // rows
    width = _SHAPE[1] // columns
    tone = np.kron(1.0 + 0.07 * rng.standard_normal((rows, columns)), np.ones((height, width)))
    within = np.ones((height, width))
    within[:joint_px] = 0.66
    within[:, :joint_px] = 0.66
    picture = tone * np.tile(within, (rows, columns))
    for row in range(1, rows, 2) if running else ():
        band = slice(row * height, (row + 1) * height)
        picture[band] = np.roll(picture[band], width // 2, axis=1)
    slabs = coloured(colour, picture * (1.0 + contrast * layered(rng, _SHAPE, (1.5, 30.0))))
    return np.rot90(slabs, -1) if upright else slabs


def _leaves(rng: np.random.Generator, colour: Rgb) -> Picture:
    picture = np.full((*_SHAPE, 3), np.array(colour) * 0.35)
    for depth in np.linspace(0.5, 1.25, 1400):
        centre = rng.integers(0, _SHAPE[0], 2)
        tint = np.array(colour) * depth * rng.uniform(0.8, 1.15) + rng.uniform(-8, 8, 3)
        angle = float(rng.uniform(0, 180))
        for wrap in np.array([[0, 0], [512, 0], [0, 512], [-512, 0], [0, -512]]):
            place = (int(centre[0] + wrap[0]), int(centre[1] + wrap[1]))
            cv2.ellipse(picture, place, (13, 7), angle, 0, 360, tint.tolist(), -1)
    return as_picture(picture)


def _weave(rng: np.random.Generator, colour: Rgb) -> Picture:
    down, across = np.indices(_SHAPE)
    threads = 0.05 * np.where((down // 4 + across // 4) % 2 == 0, 1.0, -1.0)
    return coloured(
        colour, 1.0 + threads + 0.06 * noise(rng, _SHAPE, 1.5) + 0.015 * noise(rng, _SHAPE, 40.0)
    )


_PAINTERS: Final[dict[str, Painter]] = {
    "grass": _grass, "leaves": _leaves, "paving": _paving, "plain": _plain, "rough": _rough, "weave": _weave,
}  # fmt: skip

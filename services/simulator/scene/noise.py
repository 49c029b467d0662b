"""Seamless noise, and colouring by it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray


def noise(
    rng: np.random.Generator, shape: tuple[int, int], grain_px: float | tuple[float, float]
) -> NDArray[np.float64]:
    """Return smooth noise that repeats without a seam.

    Parameters
    ----------
    rng
        Source of chance.
    shape
        Height and width in pixels.
    grain_px
        Size of the blobs, in pixels; one number, or one for each axis.

    Returns
    -------
    Array of that shape, mean 0, standard deviation 1.
    """
    down, across = grain_px if isinstance(grain_px, tuple) else (grain_px, grain_px)
    frequency_down, frequency_across = np.fft.fftfreq(shape[0])[:, None], np.fft.rfftfreq(shape[1])[None, :]
    keep = np.exp(-2.0 * ((frequency_down * down) ** 2 + (frequency_across * across) ** 2))
    # Filtering by a product of spectra is a circular convolution, which is what makes the edges meet.
    smooth = np.fft.irfft2(np.fft.rfft2(rng.standard_normal(shape)) * keep, shape)
    smooth -= smooth.mean()
    return np.asarray(smooth / max(float(smooth.std()), 1e-9), dtype=np.float64)


def layered(rng: np.random.Generator, shape: tuple[int, int], grains_px: ArrayLike) -> NDArray[np.float64]:
    """Return the sum of noises of several grains, coarse ones weighing more; standard deviation about 1."""
    grains = np.atleast_1d(np.asarray(grains_px, dtype=np.float64))
    weights = np.sqrt(grains / grains.sum())
    return np.asarray(
        sum(weight * noise(rng, shape, float(grain)) for weight, grain in zip(weights, grains, strict=True)),
        dtype=np.float64,
    )


def coloured(colour: ArrayLike, shade: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Return a picture (h, w, 3) of one RGB colour, made lighter or darker by the factors `shade` (h, w)."""
    return as_picture(np.asarray(colour, dtype=np.float64) * shade[..., None])


def tinted(picture: NDArray[np.uint8], colour: ArrayLike) -> NDArray[np.uint8]:
    """Return a picture (h, w, 3) in another colour: its mean becomes that RGB colour, its light and shade stay."""
    grey = picture.astype(np.float64).mean(axis=2)
    return coloured(colour, grey / max(float(grey.mean()), 1.0))


def as_picture(values: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Return values as a picture, cut to 0 to 255."""
    return np.clip(values, 0, 255).astype(np.uint8)

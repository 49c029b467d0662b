"""GIST modality: the spatial envelope of a scene (Oliva & Torralba 2001).

The energy of oriented filters, by cell of the image, orientation and scale: it says where the sky, the ground and the
large masses are, and keeps nothing of the objects. Parameters as in the authors' published code (LMgist), on
96 x 128 grey values: the shape of most cameras' images, so that directions stay what they are.
"""

from functools import cache

import numpy as np
from numpy import fft

from smal.arrays import Float32s, Uint8s
from smal.features.modality import unit_length
from smal.features.resizing import resized_grey

ROWS = 96
COLUMNS = 128
GRID = 4
ORIENTATIONS = 8
# Cycles per pixel at which the filters of each scale respond most.
FREQUENCIES = tuple(0.3 / 1.85**scale for scale in range(4))
SIZE = len(FREQUENCIES) * ORIENTATIONS * GRID * GRID

# Mirrored pixels on every side: the discrete Fourier transform takes the image to go on at its other side.
BORDER = 16
# What the prefilter takes away falls to one half at 4 cycles per image width: exp(-ln 2 (f / 4)^2).
_BLUR_PX = float(COLUMNS * np.sqrt(np.log(2.0)) / (4.0 * np.pi * np.sqrt(2.0)))
_LEAST_CONTRAST = 0.2


def gist_descriptor(image: Uint8s) -> Float32s:
    """Describe an RGB image, brought to 96 rows and 128 columns of grey, by its spatial envelope, (512,).

    Mean amplitude of 4 scales, fine to coarse, x 8 orientations, from 0 in steps of 22.5 degrees (that of the wave, so
    0 is a vertical edge; y points down), on a grid of 4 x 4, unit length. An image of one grey has no direction and
    gives the zero vector.
    """
    grey = resized_grey(image, ROWS, COLUMNS)
    if grey.min() == grey.max():
        # Without this, what remains is the rounding of the filters.
        return np.zeros(SIZE, dtype=np.float32)
    return unit_length(mean_amplitudes(prefiltered(grey)))


def prefiltered(grey: Uint8s) -> Float32s:
    """Take away illumination and equalize contrast (rows, columns).

    With c = log(1 + I) - g * log(1 + I) and a Gaussian g, the result is c / (0.2 + sqrt(g * c^2)).
    """
    import cv2  # noqa: PLC0415 - containers that only need SIZE have no OpenCV

    logarithm = np.log1p(grey.astype(np.float32))
    contrast = logarithm - cv2.GaussianBlur(logarithm, (0, 0), _BLUR_PX)
    local = cv2.GaussianBlur(contrast * contrast, (0, 0), _BLUR_PX)
    return np.asarray(contrast / (_LEAST_CONTRAST + np.sqrt(local)), dtype=np.float32)


def mean_amplitudes(picture: Float32s) -> Float32s:
    """Return the mean absolute response (filters, 4, 4) of every filter in every cell of a picture (96, 128)."""
    spectrum = fft.fft2(np.pad(picture, BORDER, mode="symmetric"))
    # One filter after the other: their responses together, 5 MB, take twice the time.
    return np.stack(
        [_cell_means(np.abs(fft.ifft2(spectrum * transfer))) for transfer in transfer_functions()]
    )


def _cell_means(amplitude: Float32s) -> Float32s:
    inside = amplitude[BORDER:-BORDER, BORDER:-BORDER]
    cells = inside.reshape(GRID, ROWS // GRID, GRID, COLUMNS // GRID)
    return np.asarray(cells.mean(axis=(1, 3)), dtype=np.float32)


@cache
def transfer_functions() -> Float32s:
    """Return the Gabor filters (filters, rows, columns) over the frequencies of `numpy.fft.fft2`.

    That of the centre frequency f_s and the orientation t_o is exp(-3.5 (f / f_s - 1)^2 - 2 pi (t - t_o)^2) at the
    frequency f and the angle t, and nothing of the mean passes. Each filter has one side of the plane only, so that
    the absolute value of its response is the amplitude of the wave, whatever its phase.
    """
    down = fft.fftfreq(ROWS + 2 * BORDER)[:, None]
    right = fft.fftfreq(COLUMNS + 2 * BORDER)[None, :]
    frequency = np.hypot(right, down)
    angle = np.arctan2(down, right)
    filters = []
    for centre in FREQUENCIES:
        for turn in np.pi / ORIENTATIONS * np.arange(ORIENTATIONS):
            apart = (angle - turn + np.pi) % (2.0 * np.pi) - np.pi
            filters.append(np.exp(-3.5 * (frequency / centre - 1.0) ** 2 - 2.0 * np.pi * apart**2))
    transfer = np.array(filters, dtype=np.float32)
    transfer[:, 0, 0] = 0.0
    transfer.setflags(write=False)
    return transfer

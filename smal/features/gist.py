"""GIST modality: the spatial envelope of a scene (Oliva & Torralba 2001).

The energy of oriented filters, by cell of the image, orientation and scale. It describes the arrangement of the sky,
the ground and large masses, without the objects. Parameters are as in the authors' published code (LMgist), on 96 x 128
grey values, the aspect ratio of most cameras.
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
#: Cycles per pixel of the strongest response at each scale.
FREQUENCIES = tuple(0.3 / 1.85**scale for scale in range(4))
SIZE = len(FREQUENCIES) * ORIENTATIONS * GRID * GRID

#: Mirrored pixels on every side, because the discrete Fourier transform is periodic.
BORDER = 16
#: Width of the prefilter: its gain falls to one half at 4 cycles per image width, exp(-ln 2 (f / 4)^2).
_BLUR_PX = float(COLUMNS * np.sqrt(np.log(2.0)) / (4.0 * np.pi * np.sqrt(2.0)))
_LEAST_CONTRAST = 0.2


def gist_descriptor(image: Uint8s) -> Float32s:
    """Describe an RGB image, resized to 96 rows and 128 columns of grey, by its spatial envelope, (512,).

    The mean amplitude of 4 scales, fine to coarse, times 8 orientations, from 0 in steps of 22.5 degrees (of the wave:
    0 is a vertical edge; y points down), on a grid of 4 x 4, of unit length. A constant image gives the zero vector.
    """
    grey = resized_grey(image, ROWS, COLUMNS)
    if grey.min() == grey.max():
        # Otherwise the rounding of the filters remains.
        return np.zeros(SIZE, dtype=np.float32)
    return unit_length(mean_amplitudes(prefiltered(grey)))


def prefiltered(grey: Uint8s) -> Float32s:
    """Remove illumination and equalise contrast (rows, columns).

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
    # One filter at a time: all responses together, 5 MB, take twice the time.
    responses = (fft.ifft2(spectrum * transfer) for transfer in transfer_functions())
    return np.stack([_cell_means(np.abs(response)) for response in responses])


def _cell_means(amplitude: Float32s) -> Float32s:
    inside = amplitude[BORDER:-BORDER, BORDER:-BORDER]
    cells = inside.reshape(GRID, ROWS // GRID, GRID, COLUMNS // GRID)
    return np.asarray(cells.mean(axis=(1, 3)), dtype=np.float32)


@cache
def transfer_functions() -> Float32s:
    """Return the Gabor filters (filters, rows, columns) over the frequencies of `numpy.fft.fft2`.

    At the frequency f and the angle t, the filter of the centre frequency f_s and the orientation t_o is
    exp(-3.5 (f / f_s - 1)^2 - 2 pi (t - t_o)^2), without the mean. Each filter covers one side of the plane only, so
    that the absolute value of its response is the amplitude of the wave at any phase.
    """
    down = fft.fftfreq(ROWS + 2 * BORDER)[:, None]
    right = fft.fftfreq(COLUMNS + 2 * BORDER)[None, :]
    frequency = np.hypot(right, down)
    angle = np.arctan2(down, right)
    filters = []
    for centre in FREQUENCIES:
        for turn in np.pi / ORIENTATIONS * np.arange(ORIENTATIONS):
            apart = (angle - turn + np.pi) % (2.0 * np.pi) - np.pi
            along = -3.5 * (frequency / centre - 1.0) ** 2
            filters.append(np.exp(along - 2.0 * np.pi * apart**2))
    transfer = np.array(filters, dtype=np.float32)
    transfer[:, 0, 0] = 0.0
    transfer.setflags(write=False)
    return transfer

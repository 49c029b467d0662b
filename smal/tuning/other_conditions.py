"""Views of a place under another light and from beside: a declared degradation for tuning without a second traverse.

Of one traverse the right answers are known, but its frames resemble their neighbours so much that every setting
recognizes all of them. Half of the frames are therefore shown as another day might show them: other exposure, colour
of the light and gradient of brightness, taken a little to the side and nearer, blurred, with noise, each frame's view
and exposure a little different. This stands for another traverse and is none: it knows no shadows, seasons or things
that were moved.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

_WIDTH: Final = 320
#: `extract` takes no fewer.
_LEAST_ROWS: Final = 24


@dataclass(frozen=True)
class Conditions:
    """How the degraded views differ from those that were taken.

    Parameters
    ----------
    gamma : float
        Exponent of brightness, above 0; above 1 is darker.
    cast : three floats
        Gain of red, green and blue.
    gradient : float
        How much brighter the right side is than the left one, relative to the middle, -2 to 2.
    shift : two floats
        By how much the view moves right and down, as a share of the width.
    zoom : float
        At least 1.
    blur_px : float
        Standard deviation of a Gaussian, in pixels of an image 320 wide, above 0.
    noise : float
        Standard deviation on every pixel and channel, grey levels.
    jitter : float
        Standard deviation from frame to frame of the shift, as a share of the width, and a third of it of the
        logarithm of the gain, times 10.
    """

    gamma: float
    cast: tuple[float, float, float]
    gradient: float
    shift: tuple[float, float]
    zoom: float
    blur_px: float
    noise: float
    jitter: float

    @property
    def meaning(self) -> str:
        """One line for people."""
        cast = " ".join(f"{gain:.2f}" for gain in self.cast)
        return (
            f"gamma {self.gamma:.2f}, red green blue times {cast}, {100 * self.gradient:+.0f} % brighter on the right, "
            f"view shifted {100 * self.shift[0]:+.1f} % right and {100 * self.shift[1]:+.1f} % down "
            f"(each frame {100 * self.jitter:.1f} % by chance), zoom {self.zoom:.2f}, blur {self.blur_px:.1f} px at "
            f"320, noise {self.noise:.0f}"
        )

    def degrade(self, image: NDArray[np.uint8], seed: int, frame: int) -> NDArray[np.uint8]:
        """Return an image as it would look; chance belongs to the seed and the frame.

        Parameters
        ----------
        image : uint8 array (height, width, 3)
            RGB. One wider than 320 is brought to that width first, so that noise means the same for every camera.
        seed, frame : int
            At least 0.

        Returns
        -------
        uint8 array (height, width, 3)
        """
        import cv2  # noqa: PLC0415 - as in smal.features.hog

        rng = np.random.default_rng([seed, frame])
        if image.shape[1] > _WIDTH:
            height = max(_LEAST_ROWS, round(image.shape[0] * _WIDTH / image.shape[1]))
            image = np.asarray(cv2.resize(image, (_WIDTH, height), interpolation=cv2.INTER_AREA), dtype=np.uint8)
        height, width = image.shape[:2]
        moved = np.asarray(self.shift) + self.jitter * rng.standard_normal(2)
        centre = np.array([width, height]) / 2
        offset = centre - self.zoom * centre + moved * width
        matrix = np.array([[self.zoom, 0.0, offset[0]], [0.0, self.zoom, offset[1]]])
        view = cv2.warpAffine(image, matrix, (width, height), borderMode=cv2.BORDER_REFLECT_101)
        view = cv2.GaussianBlur(view, (0, 0), self.blur_px * width / _WIDTH, borderType=cv2.BORDER_REPLICATE)
        light = 1.0 + self.gradient * np.linspace(-0.5, 0.5, width, dtype=np.float32)[:, np.newaxis]
        gain = np.exp(self.jitter * 10.0 / 3.0 * rng.standard_normal())
        bright = 255.0 * (view.astype(np.float32) / 255.0) ** self.gamma * light * (gain * np.asarray(self.cast))
        bright += self.noise * rng.standard_normal(image.shape, dtype=np.float32)
        return np.asarray(np.clip(np.rint(bright), 0, 255), dtype=np.uint8)


def evening(strength: float) -> Conditions:
    """Return darker and warmer views from further left; strength 0 (hardly any difference) and up."""
    s = strength
    return Conditions(
        1.5**s, (1.0, 0.9**s, 0.75**s), 0.35 * s, (0.03 * s, 0.01 * s), 1.0 + 0.03 * s, 0.5 + s, 5.0 * s, 0.01 * s
    )


def overcast(strength: float) -> Conditions:
    """Return brighter and bluer views from further right; strength 0 (hardly any difference) and up."""
    s = strength
    return Conditions(
        0.7**s, (0.85**s, 0.95**s, 1.0), -0.25 * s, (-0.03 * s, -0.02 * s), 1.0 + 0.05 * s, 0.5 + 0.5 * s, 8.0 * s,
        0.01 * s,
    )  # fmt: skip

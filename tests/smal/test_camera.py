"""Lenses, against OpenCV's own models of them."""

import math

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from smal.camera import Camera, Lens

ANGLES_RAD = np.radians(np.arange(0.5, 50.0, 0.5))


def by_opencv(lens: Lens, distortion: tuple[float, ...]) -> NDArray[np.float64]:
    """Return how far from the middle what is at the angles is shown, in focal lengths."""
    points = np.stack([np.sin(ANGLES_RAD), np.zeros_like(ANGLES_RAD), np.cos(ANGLES_RAD)], axis=1)[
        :, None
    ]
    still = np.zeros(3)
    if lens == "equidistant":
        shown, _ = cv2.fisheye.projectPoints(points, still, still, np.eye(3), np.array(distortion))
    else:
        shown, _ = cv2.projectPoints(points, still, still, np.eye(3), np.array(distortion))
    return np.asarray(shown[:, 0, 0])


@pytest.mark.parametrize(
    ("lens", "distortion"),
    [
        ("plumb_bob", (-0.25, 0.06, 0.0, 0.0, -0.004)),
        ("rational_polynomial", (0.5, 0.1, 0.0, 0.0, 0.02, 0.8, 0.2, 0.03)),
        ("equidistant", (-0.03, 0.002, -0.001, 0.0001)),
    ],
)
def test_lens_distorts_like_opencv(lens: Lens, distortion: tuple[float, ...]) -> None:
    camera = Camera(0.5, lens, distortion)
    expected = by_opencv(lens, distortion)
    rising = np.diff(expected, prepend=0.0) > 0.0
    np.testing.assert_allclose(camera.radius(ANGLES_RAD)[rising], expected[rising], rtol=1e-4)
    np.testing.assert_allclose(camera.angle(expected[rising]), ANGLES_RAD[rising], rtol=1e-4)


def test_lens_is_monotone_beyond_its_calibration() -> None:
    camera = Camera(0.5, "plumb_bob", (-0.5,))
    radii = camera.radius(np.linspace(0.0, math.pi, 1000))
    assert (np.diff(radii) >= 0.0).all()
    assert math.isfinite(float(radii[-1]))


@pytest.mark.parametrize("lens", ["plumb_bob", "equidistant"])
def test_camera_has_its_field_of_view(lens: Lens) -> None:
    assert Camera.of_field(100.0, lens).field_deg == pytest.approx(100.0, rel=1e-4)


@pytest.mark.parametrize("field_deg", [60.0, 120.0, 160.0, 180.0, 220.0])
def test_camera_has_its_field_when_no_lens_is_given(field_deg: float) -> None:
    assert Camera.of_field(field_deg).field_deg == pytest.approx(field_deg, rel=1e-4)


def test_field_is_rejected_when_the_lens_cannot_have_it() -> None:
    with pytest.raises(
        ValueError, match="plumb_bob must be above 0 and below 178 degrees, got 190"
    ):
        Camera.of_field(190.0, "plumb_bob")


def test_rays_are_those_of_the_image_when_it_was_stretched() -> None:
    camera = Camera(0.5, "equidistant", (0.1,), (0.05, -0.02))
    whole = camera.rays((90, 160))
    stretched = camera.rays((30, 40), aspect=90 / 160)
    for part, same in zip(whole, stretched, strict=True):
        np.testing.assert_allclose(part[1::3, 1::4], same, atol=0.02)

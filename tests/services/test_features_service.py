"""The features service: one observation of each frame."""

import subprocess
import sys

import cv2
import numpy as np
import pytest
from pydantic import ValidationError

from services.features.service import FeaturesService, FeaturesSettings
from services.kit.jpeg import encode_jpeg
from smal.features import FeatureSettings
from tests.services.chain import image


def test_detections_go_with_the_features_of_their_frame() -> None:
    tag = cv2.aruco.generateImageMarker(
        cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11), 5, 120
    )
    pixels = np.full((240, 320, 3), 255, dtype=np.uint8)
    pixels[60:180, 100:220] = tag[..., None]
    shown = image(1).model_copy(update={"data": encode_jpeg(pixels), "width": 320, "height": 240})
    observation = FeaturesService(FeatureSettings(("thumbnail", "apriltag"))).handle(shown)
    (found,) = observation.detected
    assert (found.label, found.score) == ("apriltag 5", 1.0)
    assert found.box == pytest.approx((100 / 320, 60 / 240, 220 / 320, 180 / 240), abs=0.01)
    assert observation.modalities == ("thumbnail", "apriltag")


def test_settings_reject_depth_in_one_line() -> None:
    with pytest.raises(ValidationError, match="only features of colour images are supported"):
        FeaturesSettings(modalities="color,depth")


def test_the_service_needs_no_scipy() -> None:
    """Its container image has none."""
    program = (
        "import sys\n"
        "sys.modules['scipy'] = None\n"
        "import services.features.__main__\n"
        "import numpy as np\n"
        "from smal.features import MODALITIES, FeatureSettings, extract\n"
        "names = [name for name in MODALITIES if name != 'depth']\n"
        "print(extract(np.zeros((48, 64, 3), dtype=np.uint8), FeatureSettings.of(names)).size)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) > 8244

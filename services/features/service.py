"""One frame in, one observation out."""

from __future__ import annotations

from schemas.array import Float32Array
from schemas.image import Image
from schemas.observation import Observation
from smal.features import FeatureSettings, extract


class FeaturesService:
    """Extracts the feature modalities of each camera frame.

    Parameters
    ----------
    features
        Which modalities.
    """

    def __init__(self, features: FeatureSettings) -> None:
        self._features = features

    def handle(self, image: Image) -> Observation:
        """Return the observation of one frame."""
        vector = extract(image.to_numpy(), self._features)
        return Observation.after(
            image, fingerprint=self._features.fingerprint, features=Float32Array.from_numpy(vector)
        )

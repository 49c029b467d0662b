"""Features service: computes one observation per frame."""

from pydantic import field_validator

from schemas.array import Float32Array
from schemas.camera import CompressedImage
from schemas.observation import MOST_DETECTED, Detected, Observation
from services.kit.jpeg import decode_jpeg
from services.kit.node import Detail, ServiceError
from services.kit.settings import FleetSettings
from smal.features import MODALITIES, FeatureSettings
from smal.features.percept import perceive


class FeaturesSettings(FleetSettings):
    """Settings of the features."""

    modalities: str = ",".join(FeatureSettings().modalities)
    """Feature modalities, separated by commas, in their order in the observation."""

    @field_validator("modalities")
    @classmethod
    def _known(cls, value: str) -> str:
        if "depth" in FeatureSettings.parse(value).needs:
            raise ValueError("only features of colour images are supported; omit depth")
        return value

    @property
    def features(self) -> FeatureSettings:
        """The modalities as settings of the library."""
        return FeatureSettings.parse(self.modalities)


class FeaturesService:
    """Extracts the features of each frame."""

    def __init__(self, features: FeatureSettings) -> None:
        self._features = features
        # A message names our own modalities; the fingerprint identifies a network.
        self._names = features.modalities if MODALITIES.keys() >= set(features.modalities) else ()

    def handle(self, image: CompressedImage) -> Observation:
        """Return the observation of one frame."""
        try:
            pixels = decode_jpeg(image.data)
        except ValueError as error:
            raise ServiceError(f"episode {image.episode}, frame {image.tick}: {error}") from None
        percept = perceive(pixels, self._features)
        return Observation.after(
            image,
            fingerprint=self._features.fingerprint,
            modalities=self._names,
            features=Float32Array.from_numpy(percept.features),
            picture=b"" if percept.picture is None else percept.picture.tobytes(),
            detected=tuple(Detected(**one._asdict()) for one in percept.detected[:MOST_DETECTED]),
        )

    def detail(self) -> Detail:
        """Return the modalities and their fingerprint."""
        return {
            "modalities": " ".join(self._features.modalities),
            "fingerprint": self._features.fingerprint,
        }

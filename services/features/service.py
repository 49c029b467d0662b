"""Features service: computes one observation per frame."""

import logging

from pydantic import field_validator

from schemas.array import Float32Array
from schemas.camera import CompressedImage, DepthImage
from schemas.observation import MOST_DETECTED, Detected, Observation
from services.kit.jpeg import decode_jpeg
from services.kit.node import Detail, ServiceError
from services.kit.settings import FleetSettings
from services.kit.throttle import Throttle
from smal.features import MODALITIES, FeatureSettings
from smal.features.percept import perceive

_log = logging.getLogger("features")


class FeaturesSettings(FleetSettings):
    """Settings of the features."""

    modalities: str = ",".join(FeatureSettings().modalities)
    """Feature modalities, separated by commas, in their order in the observation."""

    @field_validator("modalities")
    @classmethod
    def _known(cls, value: str) -> str:
        FeatureSettings.parse(value)
        return value

    @property
    def features(self) -> FeatureSettings:
        """The modalities as settings of the library."""
        return FeatureSettings.parse(self.modalities)


class FeaturesService:
    """Extracts features, from a frame's newest colour and depth image if depth is used."""

    def __init__(self, features: FeatureSettings) -> None:
        self.needs_depth = "depth" in features.needs
        self.without_depth = 0
        self._features = features
        # A message names only built-in modalities; the fingerprint identifies networks.
        self._names = features.modalities if MODALITIES.keys() >= set(features.modalities) else ()
        self._throttle = Throttle()
        self._image: CompressedImage | None = None
        self._depth: DepthImage | None = None

    def handle(self, image: CompressedImage) -> Observation | None:
        """Return the observation of a frame, or None while its depth image is missing."""
        if not self.needs_depth:
            return self._observation(image, None)
        waiting = self._image
        self._image = image
        if waiting is not None and not _same_frame(waiting, image):
            self._skip(waiting)
        return self._joined()

    def handle_depth(self, depth: DepthImage) -> Observation | None:
        """Return the observation of a frame, or None while its colour image is missing."""
        self._depth = depth
        return self._joined()

    def detail(self) -> Detail:
        """Return the modalities, and the number of frames without depth."""
        detail: Detail = {
            "modalities": " ".join(self._features.modalities),
            "fingerprint": self._features.fingerprint,
        }
        return detail | ({"without_depth": self.without_depth} if self.needs_depth else {})

    def _joined(self) -> Observation | None:
        image = self._image
        depth = self._depth
        if image is None or depth is None or not _same_frame(image, depth):
            return None
        # The depth image stays for a colour image that is resent after a lost answer.
        self._image = None
        return self._observation(image, depth)

    def _observation(self, image: CompressedImage, depth: DepthImage | None) -> Observation:
        try:
            pixels = decode_jpeg(image.data)
        except ValueError as error:
            raise ServiceError(f"episode {image.episode}, frame {image.tick}: {error}") from None
        percept = perceive(pixels, self._features, None if depth is None else depth.to_numpy())
        return Observation.after(
            image,
            fingerprint=self._features.fingerprint,
            modalities=self._names,
            features=Float32Array.from_numpy(percept.features),
            picture=b"" if percept.picture is None else percept.picture.tobytes(),
            detected=tuple(Detected(**one._asdict()) for one in percept.detected[:MOST_DETECTED]),
        )

    def _skip(self, image: CompressedImage) -> None:
        self.without_depth += 1
        if self._throttle.due():
            _log.warning(
                "episode %s, frame %d: no depth image received; %d frames skipped in total",
                image.episode, image.tick, self.without_depth,
            )  # fmt: skip


def _same_frame(one: CompressedImage, other: CompressedImage | DepthImage) -> bool:
    return (one.episode, one.tick) == (other.episode, other.tick)

"""Tracker service: measures one pose per overhead image."""

import logging
from typing import Annotated

from pydantic import Field

from schemas.camera import OverheadImage
from schemas.motion import TrackedPose
from services.kit.jpeg import decode_jpeg
from services.kit.node import Detail, ServiceError
from services.kit.settings import FleetSettings
from services.tracker.tag_tracking import Tag, TagNotSeen, locate

_log = logging.getLogger("tracker")


class TrackerSettings(FleetSettings):
    """Tag on the robot; the defaults are the TurtleBot's."""

    tag_number: Annotated[int, Field(ge=0, le=49)] = 7
    """Number of the ArUco marker in DICT_4X4_50."""
    tag_side_m: Annotated[float, Field(gt=0, le=10)] = 0.2
    """Side of the marker's black square, metres."""
    tag_height_m: Annotated[float, Field(ge=0, le=10)] = 0.43
    """Height of the marker above the floor, metres."""


class TrackerService:
    """Measures the robot's pose by the tag on it, from overhead images alone."""

    def __init__(self, tag: Tag) -> None:
        self._tag = tag
        self._visible = True
        self._seen = 0
        self._lost = 0

    def handle(self, image: OverheadImage) -> TrackedPose:
        """Return the pose at one frame; ServiceError for an invalid image or calibration.

        If the tag is not detected, the pose is unknown and `visible` is false.
        """
        try:
            pose = locate(self._tag, decode_jpeg(image.data), image.calibration)
        except ValueError as error:
            raise ServiceError(str(error)) from None
        except TagNotSeen as reason:
            self._lost += 1
            if self._visible:
                _log.warning(
                    "lost the tag at frame %d of episode %s: %s", image.tick, image.episode, reason
                )
            self._visible = False
            return TrackedPose.after(image, visible=False)
        self._seen += 1
        if not self._visible:
            _log.info(
                "the tag is visible again at frame %d of episode %s", image.tick, image.episode
            )
        self._visible = True
        return TrackedPose.after(image, visible=True, **pose._asdict())

    def detail(self) -> Detail:
        """Return the tag's number, and the numbers of frames with and without it."""
        return {"tag": self._tag.number, "seen": self._seen, "lost": self._lost}

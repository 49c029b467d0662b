"""One overhead image in, one tracked pose out."""

from __future__ import annotations

import logging

from schemas.overhead_image import OverheadImage
from schemas.tracked_pose import TrackedPose
from services.kit.jpeg import decode_jpeg
from services.kit.node import Detail, ServiceError
from services.tracker.tag_tracking import Tag, TagNotSeen, TagTracker

_log = logging.getLogger("tracker")


class TrackerService:
    """Measures where the robot is from the overhead image alone.

    Parameters
    ----------
    tag
        Which tag lies on the robot, and how.
    """

    def __init__(self, tag: Tag) -> None:
        self._tracker = TagTracker(tag)
        self._visible = True
        self._seen = 0
        self._lost = 0

    def handle(self, image: OverheadImage) -> TrackedPose:
        """Return the pose at one frame, or that the tag is not seen.

        Raises ServiceError when the image is none, or its calibration puts the camera below the tag.
        """
        try:
            pose = self._tracker.locate(decode_jpeg(image.data), image.calibration)
        except ValueError as error:
            raise ServiceError(str(error)) from None
        except TagNotSeen as reason:
            self._lost += 1
            if self._visible:
                _log.warning("lost the tag at frame %d of episode %s: %s", image.tick, image.episode, reason)
            self._visible = False
            return TrackedPose.after(image, visible=False)
        self._seen += 1
        if not self._visible:
            _log.info("the tag is seen again at frame %d of episode %s", image.tick, image.episode)
        self._visible = True
        return TrackedPose.after(image, visible=True, **pose._asdict())

    def detail(self) -> Detail:
        """Tell the tag's number, and in how many frames it was seen and not seen."""
        return {"tag": self._tracker.tag.number, "seen": self._seen, "lost": self._lost}

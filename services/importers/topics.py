"""Topics of a bag, chosen by their content: messages that fit the images in time and extent.

The driver's command determines the actions if it drives when the odometry moves; otherwise the
velocities of the odometry do. The pose is that of the odometry that covers the images and moves.
"""

from typing import Any, Final, NamedTuple

import numpy as np

from schemas.base import TICK_S
from schemas.codec import printable
from services.importers.bags import Received, decoded, header_of
from services.importers.clocks import captured
from services.importers.drive import Array, ImportFailure, Tally, spans
from services.importers.job import ImportJob
from services.importers.streams import (
    COMPRESSED,
    IMAGES,
    INFO,
    MEASURED,
    ODOMETRY,
    POSES,
    VELOCITIES,
    Stream,
)
from services.importers.ticks import moving
from services.kit.cameras import camera_of_ros
from smal.camera import Camera

#: Least share of the moving images with a command that drives.
_LEAST_FIT: Final = 0.8
_MOST_NAMES: Final = 10  # Topics in one line.


class _Option(NamedTuple):
    """An option that chooses a topic."""

    flag: str
    what: str


_CAMERA: Final = _Option("--camera", "image (CompressedImage or Image)")
_VELOCITY: Final = _Option(
    "--velocity", "velocity (Twist, TwistStamped, TwistWithCovarianceStamped or Odometry)"
)
_ODOMETRY: Final = _Option("--odometry", "odometry (Odometry or a pose)")
_Streams = dict[str, Stream]


class Chosen(NamedTuple):
    """The topics of a drive."""

    images: Stream
    velocity: Stream
    odometry: Stream | None
    camera: Camera | None


class Topics:
    """All topics of a bag."""

    def __init__(self, path: str, tally: Tally) -> None:
        self._path = path
        self._tally = tally
        self._streams: _Streams = {}
        self._cameras: dict[str, tuple[str, Camera]] = {}  # Frame and calibration.
        self._others: dict[str, str] = {}  # Types of topics that no drive needs.

    def take(self, message: Received, number: int) -> None:
        """Add a message; ValueError if it does not fit its type."""
        topic = message.topic
        if message.type in (*IMAGES, *VELOCITIES, *POSES):
            if topic not in self._streams:
                self._streams[topic] = Stream(topic, message.type)
            self._streams[topic].add(message, number)
        elif message.type == INFO:
            if topic not in self._cameras:
                self._calibrate(topic, header_of(message).frame, decoded(message))
        else:
            self._others[topic] = message.type

    def _calibrate(self, topic: str, frame: str, info: Any) -> None:  # noqa: ANN401 - generated
        try:
            self._cameras[topic] = frame, camera_of_ros(info)
        except ValueError as error:
            self._tally.say(f"{printable(topic)}: {error}")

    def choose(self, job: ImportJob) -> Chosen:
        """Return the topics of the drive, by content or by option."""
        self._order()
        images = self._wished(_CAMERA, job.camera, IMAGES) or self._only_camera()
        at_s = _thinned(images.times_s)
        velocity = self._wished(_VELOCITY, job.velocity, VELOCITIES)
        odometry = self._wished(_ODOMETRY, job.odometry, POSES)
        if odometry is None and velocity is not None and velocity.type == ODOMETRY:
            odometry = velocity
        odometry = odometry or self._best_odometry(at_s)
        velocity = velocity or self._best_velocity(at_s, odometry)
        self._report(images, velocity, odometry)
        return Chosen(images, velocity, odometry, self._camera_of(images))

    def _order(self) -> None:
        """Set the times of capture of all streams."""
        streams = [stream for stream in self._streams.values() if len(stream)]
        times = captured([stream.times() for stream in streams], self._tally)
        for stream, captured_s in zip(streams, times, strict=True):
            stream.settle(captured_s)

    def _of(self, types: tuple[str, ...]) -> list[Stream]:
        return [one for one in self._streams.values() if one.type in types and one.times_s.size]

    def _wished(self, option: _Option, wish: str | None, types: tuple[str, ...]) -> Stream | None:
        if wish is None:
            return None
        known = self._of(types)
        found = next((one for one in known if one.topic == wish), None)
        if found is None:
            there = ", ".join(one.text for one in known[:_MOST_NAMES]) or "none"
            raise ImportFailure(
                f"{self._path}: topic {wish} of {option.what} not found; choose from {there}"
            )
        return found

    def _missing(self, option: _Option) -> ImportFailure:
        names = sorted({*self._streams, *self._others, *self._cameras})[:_MOST_NAMES]
        there = printable(", ".join(names)) or "none"
        return ImportFailure(f"{self._path}: topic of {option.what} not found among {there}")

    def _only_camera(self) -> Stream:
        """Return the images if there is one camera; raise ImportFailure otherwise."""
        images = self._of(IMAGES)
        colour = [one for one in images if not one.depth] or images
        cameras: _Streams = {}
        for one in sorted(colour, key=lambda one: (one.times_s.size, one.type == COMPRESSED)):
            # An image and its compressed copies are one camera.
            cameras[one.topic.removesuffix("/compressed")] = one
        most = max((one.times_s.size for one in cameras.values()), default=0)
        full = [one for one in cameras.values() if 2 * one.times_s.size > most]
        if not full:
            raise self._missing(_CAMERA)
        if len(full) > 1:
            there = ", ".join(one.text for one in full[:_MOST_NAMES])
            raise ImportFailure(
                f"{self._path}: several topics of {_CAMERA.what}: {there}; choose one with "
                f"{_CAMERA.flag}"
            )
        return full[0]

    def _best_odometry(self, at_s: Array) -> Stream | None:
        """Return the poses that cover the most images, move and turn; the usual name last."""

        def fit(one: Stream) -> tuple[object, ...]:
            changes = np.nan_to_num(np.ptp(one.poses, axis=0)) > 0.0
            measured = one.type == ODOMETRY
            usual = one.topic.rpartition("/")[2] == "odom"
            return round(one.beside(at_s), 1), changes[:2].any(), measured, changes[2], usual

        # Poses that cover few images can be goals.
        poses = [
            one
            for one in self._of(POSES)
            if one.beside(at_s) >= (0.0 if one.type == ODOMETRY else _LEAST_FIT)
        ]
        return max(poses, key=fit, default=None)

    def _best_velocity(self, at_s: Array, odometry: Stream | None) -> Stream:
        """Return the command that drives when the odometry moves, else the odometry."""
        measured = odometry is not None and moving(odometry.motion).any()
        if odometry is not None and measured:
            at_s = at_s[odometry.driven(at_s)]

        others = [one for one in self._of(VELOCITIES) if one.type != ODOMETRY]
        shares = {one.topic: float(one.driven(at_s).mean()) if at_s.size else 0.0 for one in others}
        most = max(shares.values(), default=0.0)

        def fit(one: Stream) -> tuple[bool, float, bool]:
            share = shares[one.topic]
            commanded = one.type != MEASURED and share >= _LEAST_FIT * most
            return commanded, round(share, 1), one.topic.rpartition("/")[2] == "cmd_vel"

        best = max(others, key=fit, default=None)
        if best is not None and (shares[best.topic] >= _LEAST_FIT or not measured):
            return best
        if odometry is None:
            raise self._missing(_VELOCITY)
        if best is not None:
            self._tally.say(
                f"{best.text} drives at {shares[best.topic]:.0%} of the images at which "
                f"{printable(odometry.topic)} moves; velocities are those of the odometry"
            )
        return odometry

    def _camera_of(self, images: Stream) -> Camera | None:
        """Return the calibration in the nearest namespace of the images, or of their frame."""
        found: list[tuple[tuple[int, bool], Camera]] = []
        for topic, (frame, camera) in self._cameras.items():
            folder = topic.rpartition("/")[0]
            same = frame == images.frame
            above = images.topic.startswith(f"{folder}/")
            # At the root a calibration of another camera also stands above the images.
            if above and (folder or same):
                found.append(((folder.count("/") + 1, same), camera))
            elif same and frame:
                found.append(((0, same), camera))
        best = max((fit for fit, _ in found), default=None)
        cameras = [camera for fit, camera in found if fit == best]
        return cameras[0] if len(cameras) == 1 else None

    def _report(self, images: Stream, velocity: Stream, odometry: Stream | None) -> None:
        if odometry is not None:
            self._tally.say(f"odometry from {printable(odometry.topic)}")
            unknown = np.isnan(odometry.poses[:, 2])
            if unknown.any():
                self._tally.say(
                    f"{printable(odometry.topic)}: {int(unknown.sum())} of {unknown.size} "
                    "orientations are no rotation (a zero quaternion)"
                )
        self._tally.say(
            f"images from {printable(images.topic)}, velocities from {printable(velocity.topic)}"
        )
        for one in (velocity, odometry):
            if one is not None and one.sideways_s.size:
                self._tally.say_all(
                    f"{printable(one.topic)} goes sideways, without a matching action, at",
                    spans(one.sideways_s - images.times_s[0]),
                )
                break
        used = (images, velocity, odometry)
        rest = [one.text for one in self._streams.values() if one not in used]
        if self._others:
            kinds = printable(", ".join(sorted(set(self._others.values()))), 200)
            rest.append(f"{len(self._others)} of other types ({kinds})")
        if rest:
            self._tally.say(f"topics not used: {', '.join(rest)}")


def _thinned(times_s: Array) -> Array:
    """Return times at most ten a second."""
    passed_s = float(np.ptp(times_s)) if times_s.size else 0.0
    every = max(1, int(times_s.size * TICK_S / max(passed_s, TICK_S)))
    return times_s[::every]

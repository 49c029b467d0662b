"""Drive of a bag, of ROS 2 or ROS 1: topics by content, times of capture.

The driver's command determines the actions; odometry, if any, gives the pose.
"""

from collections.abc import Iterator
from functools import partial
from typing import Final

import numpy as np
from numpy.typing import NDArray

from services.importers.bags import Received, bags_of, decoded, received
from services.importers.drive import Image, ImportedDrive, ImportFailure, NotAnImage, Reads, Tally
from services.importers.images import ros_as_jpeg
from services.importers.inside import Inside
from services.importers.job import ImportJob
from services.importers.topics import Topics
from services.kit.pixels import BitDepth

#: Largest number of images that wait for an image before them: two seconds at 60 Hz.
_MOST_WAITING: Final = 120


def found(inside: Inside) -> bool:
    """Return whether a file is a bag, or a folder has bags."""
    return bool(bags_of(inside))


def read(inside: Inside, job: ImportJob, tally: Tally) -> Reads:
    """Return the read of each bag, which is one drive."""
    job.check_used("a bag", "camera", "velocity", "odometry", "speed", "turn_rate")
    bags = bags_of(inside)
    if not bags:
        raise ImportFailure(f"{inside.path}: no *.mcap, *.db3 or *.bag in this folder")
    return {name: partial(_drives, inside, name, bags[name], job, tally) for name in bags}


def _drives(
    inside: Inside, name: str, files: list[str], job: ImportJob, tally: Tally
) -> list[ImportedDrive]:
    topics = Topics(inside.called(files[0]), tally)
    for number, message in enumerate(received(inside, files, tally)):
        try:
            topics.take(message, number)
        except ValueError:
            tally.count(f"messages of {message.topic} do not match their type")
    images, velocity, odometry, camera = topics.choose(job)
    speed, turn_rate = job.scale()
    drive = ImportedDrive.of_rows(
        name,
        images.times_s,
        partial(_images, inside, files, images.numbers, tally, BitDepth()),
        velocity.reported * (1.0, speed, turn_rate),
        [] if odometry is None else odometry.track,
        tally,
        twist=np.zeros((0, 3)) if odometry is None else odometry.reported,
        camera=camera,
        turn_rate=turn_rate,
    )
    return [drive]


def _images(
    inside: Inside, files: list[str], numbers: NDArray[np.int64], tally: Tally, depth: BitDepth
) -> Iterator[Image]:
    """Yield the images with these numbers of messages, in this order."""
    wanted = set(numbers.tolist())
    waiting: dict[int, Image] = {}
    due = iter(numbers.tolist())
    first = next(due, None)
    for number, message in enumerate(received(inside, files, Tally())):
        if number not in wanted:
            continue
        waiting[number] = partial(_image, message, tally, depth)
        if len(waiting) > _MOST_WAITING:
            raise ImportFailure(
                f"{inside.path}: an image is more than {_MOST_WAITING} images late; "
                "sort the bag by time first"
            )
        while first in waiting:
            yield waiting.pop(first)
            first = next(due, None)


def _image(message: Received, tally: Tally, depth: BitDepth) -> bytes:
    try:
        image = decoded(message)
    except ValueError:
        raise NotAnImage("images are damaged") from None
    return ros_as_jpeg(image, tally, depth)

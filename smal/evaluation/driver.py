"""Protocol of a method that drives a robot back to where it was taught to go.

A method is a callable of the taught drives that returns a `Driver`: a class, for example. It is taught once, and the
driver then begins many episodes. ``services/experiments/PROTOCOL.md`` describes the comparison of drivers.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple, Protocol

from smal.arrays import Float32s, Uint8s
from smal.movement import Motion
from smal.obstacles.clearance import Mount
from smal.planning import Said
from smal.teaching.demonstration import Demonstration

#: Depth image (height, width) in metres, 0 = not measured, and the mount of its camera.
Depth = tuple[Float32s, Mount]


class PlaceEstimate(NamedTuple):
    """A taught frame, and the robot's offset from the pose of that frame."""

    #: Number of the frame, counted over all taught drives.
    frame: int
    #: Metres.
    ahead: float = 0.0
    left: float = 0.0
    #: Turn to the left.
    turned_rad: float = 0.0


class Driver(Protocol):
    """Drives a robot: takes images and returns velocities.

    Attributes
    ----------
    said : {"found", "not_here"} or None
        Announced result after the last image, which ends the episode; None while the robot is under way.
    place : PlaceEstimate or None
        Estimated place after the last image; None if the driver is lost or has no estimate.
    """

    @property
    def said(self) -> Said | None:
        """Announced result."""

    @property
    def place(self) -> PlaceEstimate | None:
        """Estimated place."""

    def reset(self, seed: int) -> None:
        """Start a new episode.

        Parameters
        ----------
        seed : int
            Seed of the driver's own random numbers, so that an episode can be repeated.
        """

    def step(
        self, image: Uint8s, odometry: Sequence[float], depth: Depth | None, elapsed_s: float
    ) -> Motion:
        """Return the velocity until the next image.

        Parameters
        ----------
        image : array (height, width, 3)
            RGB, uint8.
        odometry : sequence (3,)
            Odometry pose at the image: x and y in metres, and heading in radians; (0, 0, 0) at the start.
        depth : (array (height, width), Mount), optional
            Depth image; None without a depth camera.
        elapsed_s : float
            Time since the image before, seconds.

        Returns
        -------
        (float, float)
            Linear velocity ahead and angular velocity to the left, as shares of the robot's own, -1 to 1.
        """


#: Learns from drives. The folder is the driver's own and empty at first; a driver that saves its model there finds it
#: when another process teaches it the same drives.
LearnDriver = Callable[[Sequence[Demonstration], Path], Driver]

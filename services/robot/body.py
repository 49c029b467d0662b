"""Interface of a robot's body: simulated, real or in a test."""

from collections.abc import Collection, Iterator
from dataclasses import dataclass
from typing import Final, NamedTuple, Protocol, TypeVar, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from schemas.base import Message, Velocity
from schemas.rpc import ResetRequest
from services.kit.node import Detail, ServiceError
from smal.camera import Camera
from smal.obstacles.clearance import Mount


class OdometryReading(NamedTuple):
    """Pose by odometry since the episode began, and mean speeds since the last reading."""

    x_m: float
    y_m: float
    heading_rad: float
    speed_m_s: float
    turn_rate_rad_s: float


@dataclass(frozen=True)
class Kinematics:
    """Nominal speeds, greater than 0, and minimum turning radius, greater than 0 for a car."""

    speed_m_s: float
    turn_rate_rad_s: float
    radius_m: float = 0.0

    def bounded(self, asked: Velocity) -> Velocity:
        """Return the nearest feasible velocity: a car cannot turn on the spot."""
        if self.radius_m == 0.0:
            return asked
        most = abs(asked.linear) * self.speed_m_s / (self.radius_m * self.turn_rate_rad_s)
        return asked._replace(angular=min(max(asked.angular, -most), most))


# Ahead, to the left, and up.
Triple = tuple[float, float, float]


class ImuReading(NamedTuple):
    """Inertial reading over one time step, about and along the axes ahead, left and up."""

    # End of the step, seconds since the episode began.
    after_s: float
    angular_velocity_rad_s: Triple
    acceleration_m_s2: Triple  # Gravity is an acceleration upwards.


class View(Protocol):
    """Sensor readings of one moment; rendered images are computed on access."""

    @property
    def captured_s(self) -> float:
        """Capture time, by the actuator's clock."""

    @property
    def jpeg(self) -> bytes:
        """Camera image, as JPEG."""

    @property
    def contact(self) -> bool:
        """Whether the robot has touched anything since the episode began."""

    @property
    def odometry(self) -> OdometryReading | None:
        """Odometry, or None without any."""

    @property
    def imu(self) -> tuple[ImuReading, ...] | None:
        """Inertial readings since the previous frame, oldest first; None without such a unit."""

    @property
    def depth(self) -> NDArray[np.float32] | None:
        """Depth image, (height, width) metres, 0 if unknown; None without an image."""

    def more(self, header: Message, made: Collection[str] = ()) -> Iterator[Message]:
        """Yield the subscribed messages of this moment, except for the topics in ``made``."""


@dataclass(frozen=True)
class Beginning:
    """Start of an episode."""

    route: tuple[tuple[float, float], ...] = ()
    """Way points from the start to the goal, metres; empty if unknown."""
    # Distance at which the goal counts as found; None if its position is unknown.
    found_m: float | None = None
    # Position of the victim, metres; None if unknown or absent.
    victim: tuple[float, float] | None = None
    # Outlines of untaught obstacles, metres, if known.
    things: tuple[tuple[tuple[float, float], ...], ...] = ()


V_co = TypeVar("V_co", bound=View, covariant=True)


class Stops(Protocol):
    """Stopping behaviour of a body."""

    @property
    def name(self) -> str:
        """Name of the world, or of a real robot."""

    @property
    def watchdog_s(self) -> float:
        """Seconds without ``drive`` or ``stand`` after which the base stops by itself."""

    @property
    def braking_s(self) -> float:
        """Seconds from nominal speed to standstill."""


#: Fields of a `ResetRequest` that change the conditions of an episode.
CONDITIONS: Final = (
    "start", "kidnap_tick", "victim", "obstacles", "people", "blocked", "world", "variation",
)  # fmt: skip


class Body(Stops, Protocol[V_co]):
    """Wheels and a camera.

    A separate thread calls ``drive`` and ``stand`` 50 times a second; they must return at once.
    """

    kinematics: Kinematics

    @property
    def frame_s(self) -> float:
        """Time between two frames, seconds."""

    @property
    def conditions(self) -> Collection[str]:
        """Names of the `CONDITIONS` that it can fulfil."""

    @property
    def camera(self) -> Camera | None:
        """Camera model, if known."""

    @property
    def mount(self) -> Mount | None:
        """Position of the depth camera; without one the gate does not avoid obstacles."""

    def drive(self, velocity: Velocity) -> Velocity:
        """Drive at a velocity until the next call; return the executed velocity, which can be 0."""

    def stand(self) -> None:
        """Stop until the next `drive`."""

    def begin(self, request: ResetRequest) -> Beginning:
        """Prepare an episode; ServiceError if that is impossible."""

    def look(self, tick: int) -> V_co:
        """Return the current readings as the frame of a tick; the first tick of an episode is 0."""

    def peek(self) -> bytes | None:
        """Return the camera image between two episodes, as JPEG; None without an image."""

    def detail(self) -> Detail:
        """Return the body's part of the robot's status; thread-safe."""


@runtime_checkable
class Carriable(Protocol):
    """Part of a simulated body that a person can carry elsewhere, and give another task."""

    @property
    def pose(self) -> tuple[float, float, float]:
        """Ground truth: metres, and radians from east."""

    def carry(self, x_m: float, y_m: float, heading_rad: float) -> None:
        """Move the robot elsewhere at rest; ServiceError if the place is not free."""

    def choose_task(self, start: tuple[float, float], goal: tuple[float, float]) -> None:
        """Move start and goal of the world, metres; ServiceError without a free way."""


def check_conditions(body: Body[View], request: ResetRequest) -> None:
    """Raise ServiceError for a requested condition that a body cannot fulfil."""
    usual = ResetRequest(seed=0)
    for name in CONDITIONS:
        value = getattr(request, name)
        if name not in body.conditions and value != getattr(usual, name):
            raise ServiceError(
                f"{body.name}: {name} {value} is unsupported by this body; leave it out"
            )

"""What a robot's body has to be able to do: a simulated one, a real one, or one in a test."""

from collections.abc import Collection, Iterator
from dataclasses import dataclass
from typing import NamedTuple, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from schemas.base import Message, Velocity
from schemas.rpc import ResetRequest
from services.kit.node import Detail
from smal.camera import Camera
from smal.obstacles.clearance import Mount


class OdometryReading(NamedTuple):
    """Where the wheels say that the robot is since the episode began, and its mean speeds since the last reading."""

    x_m: float
    y_m: float
    heading_rad: float
    speed_m_s: float
    turn_rate_rad_s: float


@dataclass(frozen=True)
class Kinematics:
    """How a robot can move: its nominal speeds, greater than 0, and the least radius of its way, above 0 of a car."""

    speed_m_s: float
    turn_rate_rad_s: float
    radius_m: float = 0.0

    def bounded(self, asked: Velocity) -> Velocity:
        """Return the velocity nearest to the asked one that it can drive: a car cannot turn on the spot."""
        if self.radius_m == 0.0:
            return asked
        most = abs(asked.linear) * self.speed_m_s / (self.radius_m * self.turn_rate_rad_s)
        return asked._replace(angular=min(max(asked.angular, -most), most))


Triple = tuple[float, float, float]  # Ahead, to the left, and up.


class ImuReading(NamedTuple):
    """What the inertial unit felt over one step of time, about and along the axes ahead, left and up."""

    after_s: float  # End of the step, seconds since the episode began.
    angular_velocity_rad_s: Triple
    acceleration_m_s2: Triple  # Gravity is felt as an acceleration upwards.


class View(Protocol):
    """What a body saw and felt at one moment. What takes long, as rendering does, is done when it is asked for."""

    @property
    def captured_s(self) -> float:
        """When that was, by the actuator's clock."""

    @property
    def jpeg(self) -> bytes:
        """The camera image, as JPEG."""

    @property
    def contact(self) -> bool:
        """Whether the robot has touched anything since the episode began."""

    @property
    def odometry(self) -> OdometryReading | None:
        """What the wheels say, if they say anything."""

    @property
    def imu(self) -> tuple[ImuReading, ...] | None:
        """The inertial readings since the frame before, oldest first; None without such a unit."""

    @property
    def depth(self) -> NDArray[np.float32] | None:
        """What the depth camera measures, (height, width) metres, 0 where nothing; None without a picture of it."""

    def more(self, header: Message, made: Collection[str] = ()) -> Iterator[Message]:
        """Make the other messages of this moment that somebody wants, but for the topics that were made before."""


@dataclass(frozen=True)
class Beginning:
    """Where an episode begins."""

    route: tuple[tuple[float, float], ...] = ()
    """Way points from there to the goal, metres; none where the way is not known."""
    found_m: float | None = (
        None  # How near the goal counts as found; None where nobody knows where it is.
    )
    victim: tuple[float, float] | None = (
        None  # Where the victim lies, metres; None where it is not known, or nowhere.
    )
    things: tuple[
        tuple[tuple[float, float], ...], ...
    ] = ()  # Outlines of what stands there anew, metres, if known.


V_co = TypeVar("V_co", bound=View, covariant=True)


class Stops(Protocol):
    """What tells how a body stops: it itself, or what it is made from."""

    @property
    def name(self) -> str:
        """Of the world that it is in, or of the robot where that is the real one."""

    @property
    def watchdog_s(self) -> float:
        """Seconds without ``drive`` or ``stand`` after which the base stands by itself."""

    @property
    def braking_s(self) -> float:
        """Seconds from nominal speed to standing."""


class Body(Stops, Protocol[V_co]):
    """Wheels and a camera; ``drive`` and ``stand`` return at once, 50 times a second on a thread of their own."""

    kinematics: Kinematics

    @property
    def camera(self) -> Camera | None:
        """How the camera sees, if it is known."""

    @property
    def mount(self) -> Mount | None:
        """How its depth camera sits; without one the gate does not keep the robot from running into things."""

    def drive(self, velocity: Velocity) -> Velocity:
        """Go on with a velocity until told otherwise; return what is carried out, which may be to stand."""

    def stand(self) -> None:
        """Stop, and stay."""

    def begin(self, request: ResetRequest) -> Beginning:
        """Be ready for an episode. Raises ServiceError when it cannot."""

    def look(self, tick: int) -> V_co:
        """Return what is seen and felt now, for the frame of a tick; the first of an episode is 0."""

    def peek(self) -> bytes | None:
        """Return what its camera sees between two episodes, as JPEG; None where that shows nothing."""

    def detail(self) -> Detail:
        """Tell how it is, for the robot's status; called on any thread."""

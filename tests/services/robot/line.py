"""A robot on a line without pixels: a goal and a wall ahead, and a clock that the test moves."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from schemas.base import STANDING, TICK_S, Atom, Message, Velocity
from schemas.camera import DepthImage
from schemas.motion import TruePose
from schemas.rpc import ResetRequest
from schemas.topics import DEPTH, Topic
from services.kit.jpeg import encode_jpeg
from services.robot.body import CONDITIONS, Beginning, ImuReading, Kinematics, OdometryReading
from smal.camera import Camera
from smal.obstacles.clearance import Mount

SPEED_M_S = 2.0


class Clock:
    """A clock that the test moves."""

    def __init__(self) -> None:
        self.now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


@dataclass(frozen=True, eq=False)
class LineView:
    """The view of the robot on the line: its position."""

    body: LineBody
    x: float
    captured_s: float
    contact: bool
    odometry: OdometryReading | None
    imu: tuple[ImuReading, ...] | None
    depth: NDArray[np.float32] | None = None

    @cached_property
    def jpeg(self) -> bytes:
        self.body.render(self.x)
        return encode_jpeg(np.full((24, 32, 3), int(10 * self.x) % 256, dtype=np.uint8))

    def more(self, header: Message, made: Collection[str] = ()) -> Iterator[Message]:
        if TruePose.topic not in made:
            yield TruePose.after(header, x_m=self.x, y_m=0.0, heading_rad=0.0)
        if DEPTH.name not in made and self.body.wanted(DEPTH):
            self.body.made[DEPTH] += 1
            yield DepthImage.after(header, width=1, height=1, data=b"\1\0")


class LineBody:
    """Moves by the test's clock in real time, and by ``advance`` in lockstep."""

    name = "line"
    kinematics = Kinematics(SPEED_M_S, 1.0)
    camera: Camera | None = Camera(0.6)
    mount: Mount | None = None
    watchdog_s = 0.2
    frame_s = TICK_S
    conditions = CONDITIONS
    braking_s = 0.0

    def __init__(
        self,
        clock: Callable[[], float],
        goal: float = 1e9,
        wall: float = 1e9,
        sight: float = 1e9,
        wanted: Callable[[Topic], bool] = lambda _: False,
    ) -> None:
        self.clock = clock
        self.wanted = wanted
        self.x = 0.0
        self.goal = goal
        self.wall = wall
        self.sight = sight
        self.moves: list[tuple[Atom, float, float]] = []
        self.orders: list[tuple[Atom, float]] = []
        self.made: Counter[Topic] = Counter()
        self.senses = True
        self._order = STANDING
        self._at_s = clock()

    def begin(self, request: ResetRequest) -> Beginning:
        self.x = 30.0 if request.start == "anywhere" else 0.0
        self.moves.clear()
        self._order = STANDING
        self._at_s = self.clock()
        return Beginning(((0.0, 0.0), (self.goal, 0.0)), 5.0)

    def drive(self, velocity: Velocity) -> Velocity:
        now = self.clock()
        self.advance(self._order, now - self._at_s)
        self._order = velocity
        self._at_s = now
        self.orders.append((velocity.atom(), max(map(abs, velocity))))
        return velocity

    def stand(self) -> None:
        self.drive(STANDING)

    def advance(self, velocity: Velocity, duration_s: float) -> None:
        self.moves.append((velocity.atom(), max(map(abs, velocity)), duration_s))
        self.x += velocity.linear * SPEED_M_S * duration_s

    def render(self, x: float) -> None:
        """Take a picture; for a body that fails, or takes its time."""

    def look(self, tick: int) -> LineView:
        odometry = OdometryReading(self.x, 0.0, 0.0, SPEED_M_S, 0.0) if self.senses else None
        imu = (ImuReading(0.02, (0.0, 0.0, 0.1), (0.0, 0.0, 9.81)),) if self.senses else None
        return LineView(self, self.x, self.clock(), self.x >= self.wall, odometry, imu)

    def peek(self) -> bytes | None:
        return self.look(0).jpeg

    def detail(self) -> dict[str, str | int | float | bool | None]:
        return {"goal": self.goal}


class Reach:
    """The task of being between the goal and as far behind it as it can be seen from."""

    def reached(self, view: LineView, _goal: str) -> bool:
        return view.body.goal <= view.x <= view.body.goal + view.body.sight

    def gone(self, view: LineView, _goal: str) -> bool:
        return view.body.goal > 1e6

    def told(self, view: LineView, _goal: str) -> None:
        view.body.goal = view.x

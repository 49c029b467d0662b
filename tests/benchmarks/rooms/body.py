"""The rooms as a body: ``smal up --robot-module tests.benchmarks.rooms.body`` serves the way "workshop"."""

from services.robot.body import Kinematics
from services.robot.gymnasium_body import GymnasiumBody
from services.robot.lockstep import serve_body
from smal.camera import Camera
from tests.benchmarks.rooms.environment import (
    BRAKING_S,
    FRAME_S,
    SPEED_M_S,
    TURN_RATE_RAD_S,
    RoomsEnv,
)
from tests.benchmarks.rooms.scene import FIELD_DEG, WAYS


class RoomsBody(GymnasiumBody):
    """The robot in the rooms, on one of the ways."""

    conditions = ("start", "kidnap_tick")
    camera = Camera.of_field(FIELD_DEG)
    braking_s = BRAKING_S

    def __init__(self, way: str, width: int = 320, height: int = 240) -> None:
        env = RoomsEnv(way, width, height)
        self.close = env.close
        kinematics = Kinematics(SPEED_M_S, TURN_RATE_RAD_S)
        super().__init__(env, lambda velocity: velocity, kinematics, frame_s=FRAME_S)


if __name__ == "__main__":
    serve_body(lambda: RoomsBody(next(iter(WAYS))))

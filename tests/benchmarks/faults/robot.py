"""The robot of the benchmark: the service as it is, with wheels in another process and a simulated camera.

``python -m tests.benchmarks.faults.robot --wheels ADDRESS`` is what the stack runs in place of the simulator.
"""

import time
from collections.abc import Callable

from schemas.base import STANDING, Velocity
from schemas.topics import Topic
from services.kit.process import configure_logging, read_settings, run_service
from services.robot.clock import Clocks, now_s
from services.robot.service import ROBOT, serve_robot
from services.simulator.base import STEP_S
from services.simulator.body import SimulatedBody
from services.simulator.sensors.camera import CameraSettings, FindVictim
from services.simulator.simulation import Simulation
from services.simulator.world import load_world
from services.simulator.worlds import SimulatorSettings
from tests.benchmarks.faults.wheels import FarBase


class FarBody(SimulatedBody):
    """A body whose base moves by itself: what it did is taken over at each look."""

    def __init__(
        self, simulation: Simulation, base: FarBase, wanted: Callable[[Topic], bool]
    ) -> None:
        super().__init__(simulation, wanted=wanted)
        self._base = base

    def drive(self, velocity: Velocity) -> Velocity:
        """Go on with a velocity until told otherwise."""
        self._base.order(velocity)
        return velocity

    def _catch_up(self, _now_s: float) -> None:
        for _ in range(self._base.fetch()):
            self.simulation.advance(STANDING, STEP_S)


class Settings(SimulatorSettings):
    """Those of the simulator that are about world and camera, and the wheels."""

    wheels: str
    """Address of the moving base."""


def serve() -> None:
    """Be a robot until stopped."""
    settings = read_settings(Settings, "simulator")
    configure_logging(settings.log_level)
    base = FarBase(settings.wheels)
    camera = CameraSettings(settings.camera_width, settings.camera_height)
    simulation = Simulation(load_world(settings.world), camera, base, depth=settings.depth)
    serve_robot(
        settings,
        lambda node: (FarBody(simulation, base, node.bus.has_listeners), {}),
        FindVictim(),
        # The stamps of its frames are of the clock that the base's log has, so that the two compare exactly.
        clocks=Clocks(now_s, lambda: time.clock_gettime_ns(time.CLOCK_BOOTTIME)),
    )


if __name__ == "__main__":
    run_service(ROBOT, serve)

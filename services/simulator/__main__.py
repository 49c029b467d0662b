"""Run the simulated robot: ``python -m services.simulator --world campus``."""

import logging

from schemas.rpc import Nothing
from services.kit.node import Node
from services.kit.process import configure_logging, read_settings, run_service
from services.robot.clock import SimulatedClock
from services.robot.lockstep import Lockstep
from services.robot.pace import Paces
from services.robot.service import ROBOT, serve_robot
from services.robot.task import OperatorsTask
from services.simulator.body import SimulatedBody
from services.simulator.plan import plan_of
from services.simulator.sensors.camera import FindVictim, SimulatedView
from services.simulator.worlds import SimulatorSettings, Worlds


def serve() -> None:
    """Serve a simulated robot until stopped."""
    settings = read_settings(SimulatorSettings, "simulator")
    configure_logging(settings.log_level)
    # Large worlds take minutes to open, and waiting clients display the last log line.
    logging.getLogger(ROBOT).info("opening the world %s", settings.world)
    worlds = Worlds(settings)
    simulation = worlds.open()
    clock = SimulatedClock()

    def open_body(node: Node) -> tuple[SimulatedBody, Paces[SimulatedView]]:
        size = f"{settings.camera_width}x{settings.camera_height}"
        node.log.info(
            "world %s (%s), camera %s, %s base",
            simulation.name,
            settings.variation,
            size,
            settings.base,
        )
        body = SimulatedBody(simulation, clock, node.bus.has_listeners, worlds)
        node.serve("plan", Nothing, lambda _: plan_of(body.simulation.world))
        return body, {"lockstep": lambda: Lockstep(body)}

    task = FindVictim() if settings.task == "victim" else OperatorsTask()
    serve_robot(settings, open_body, task, clocks=clock.clocks)


if __name__ == "__main__":
    run_service(ROBOT, serve)

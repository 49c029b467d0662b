"""Run the simulated robot: ``python -m services.simulator --world campus``."""

from __future__ import annotations

import secrets

from services.kit.node import Node, ServiceError, configure_logging, read_settings, run_service
from services.robot.gate import CommandGate
from services.robot.loop import check_stopping
from services.robot.runner import EpisodeRunner
from services.robot.service import ROBOT, RobotService, check_alone
from services.robot.task import OperatorsTask
from services.simulator.body import SimulatedBody
from services.simulator.config import SimulatorSettings
from services.simulator.lockstep import Lockstep
from services.simulator.opening import open_simulation
from services.simulator.physics.engine import PhysicsUnavailableError
from services.simulator.scene.vulkan import RenderingUnavailableError
from services.simulator.sensors.camera import CameraSettings
from services.simulator.view import FindVictim
from services.simulator.world import WorldError


def serve() -> None:
    """Simulate until stopped."""
    settings = read_settings(SimulatorSettings, "simulator")
    configure_logging(settings.log_level)
    try:
        camera = CameraSettings(settings.camera_width, settings.camera_height, settings.shadows)
        simulation = open_simulation(
            settings.world, camera, base=settings.base, shake=settings.shake, variation=settings.variation
        )
    except (WorldError, RenderingUnavailableError, PhysicsUnavailableError) as error:
        raise ServiceError(str(error)) from None
    check_alone(settings)
    with Node(ROBOT, settings) as node:
        node.stop_on_signals()
        body = SimulatedBody(simulation, wanted=node.bus.has_listeners)
        check_stopping(body)
        runner = EpisodeRunner(
            body,
            FindVictim() if settings.task == "victim" else OperatorsTask(),
            CommandGate(attended=settings.attended),
            settings.robot,
            # Episode ids stay unique when the simulator is restarted, whatever the wall clock says.
            secrets.token_hex(6),
            paces={"lockstep": lambda: Lockstep(body)},
        )
        RobotService(runner, node)
        size = f"{settings.camera_width}x{settings.camera_height}"
        node.log.info("world %s (%s), camera %s, %s base", simulation.name, settings.variation, size, settings.base)
        try:
            node.spin()
        finally:
            node.publish(runner.end())


if __name__ == "__main__":
    run_service(ROBOT, serve)

"""Run the simulator: ``python -m services.simulator --world campus``."""

from __future__ import annotations

import secrets

from services.kit.node import Node, ServiceError, configure_logging, read_settings, run_service
from services.simulator.config import SimulatorSettings
from services.simulator.episode import EpisodeRunner
from services.simulator.opening import open_simulation
from services.simulator.physics.engine import PhysicsUnavailableError
from services.simulator.scene.vulkan import RenderingUnavailableError
from services.simulator.sensors.camera import CameraSettings
from services.simulator.service import SimulatorService
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
    # Episode ids stay unique when the simulator is restarted, whatever the wall clock says.
    session = secrets.token_hex(6)
    with Node("simulator", settings) as node:
        node.stop_on_signals()
        runner = EpisodeRunner(simulation, settings.robot, session, wanted=node.bus.has_listeners)
        SimulatorService(runner, node)
        size = f"{settings.camera_width}x{settings.camera_height}"
        node.log.info("world %s (%s), camera %s, %s base", simulation.name, settings.variation, size, settings.base)
        node.spin()


if __name__ == "__main__":
    run_service("simulator", serve)

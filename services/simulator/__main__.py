"""Run the simulator: ``python -m services.simulator --world campus``."""

from __future__ import annotations

import time

from services.process import Node, ServiceError, configure_logging, read_settings, run_service
from services.simulator.config import SimulatorSettings
from services.simulator.episode import EpisodeRunner
from services.simulator.scene.vulkan import RenderingUnavailableError
from services.simulator.service import SimulatorService
from services.simulator.simulation import CameraSettings, Simulation
from services.simulator.world import WorldError, load_world


def serve() -> None:
    """Simulate until stopped."""
    settings = read_settings(SimulatorSettings, "simulator")
    configure_logging(settings.log_level)
    try:
        world = load_world(settings.world)
        camera = CameraSettings(settings.camera_width, settings.camera_height, settings.shadows)
        simulation = Simulation(world, camera)
    except (WorldError, RenderingUnavailableError) as error:
        raise ServiceError(str(error)) from None
    # Episode ids stay unique when the simulator is restarted.
    session = f"{time.time_ns() // 1_000_000:x}"
    with Node("simulator", settings) as node:
        node.stop_on_signals()
        SimulatorService(EpisodeRunner(simulation, settings.robot, session), node)
        node.log.info("world %s, camera %dx%d", world.name, settings.camera_width, settings.camera_height)
        node.spin()


if __name__ == "__main__":
    run_service("simulator", serve)

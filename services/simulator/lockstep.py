"""An episode of a simulation in this process, without messages."""

from schemas.rpc import ResetRequest
from services.robot.lockstep import SteppedEpisode
from services.simulator.body import SimulatedBody
from services.simulator.sensors.camera import FindVictim, SimulatedView
from services.simulator.simulation import Simulation


class LockstepEpisode(SteppedEpisode[SimulatedView]):
    """An episode of a simulation, with the same poses as an episode over messages."""

    def __init__(self, simulation: Simulation, request: ResetRequest) -> None:
        super().__init__(SimulatedBody(simulation), FindVictim(), request)

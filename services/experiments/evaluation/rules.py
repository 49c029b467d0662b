"""When an episode ends in lockstep, and how: the rules of `services.simulator.episode`, without messages."""

from __future__ import annotations

from typing import Final

from schemas.base import Atom as AtomName
from schemas.base import Message
from schemas.episode import Outcome, Purpose
from services.robot.outcome import outcome_of
from services.simulator.drive import TICK_S
from services.simulator.sensors.messages import odometry_message
from services.simulator.simulation import Simulation
from smal.action_space import Atom

_NAMES: Final[dict[Atom, AtomName]] = {
    Atom.STOP: "stop",
    Atom.FORWARD: "forward",
    Atom.BACKWARD: "backward",
    Atom.LEFT: "left",
    Atom.RIGHT: "right",
}

#: x, y in metres and heading in radians.
Pose = tuple[float, float, float]
_HEADER: Final = Message(robot="any", episode="any", tick=0, stamp_ns=0)


def odometry_of(simulation: Simulation) -> Pose:
    """Return where the wheels say that the robot is, with the digits that the simulator's message has."""
    said = odometry_message(_HEADER, simulation.odometry())
    return said.x_m, said.y_m, said.heading_rad


def advance(simulation: Simulation, atom: Atom) -> None:
    """Carry out an atom movement until the next frame, at nominal speed."""
    simulation.advance(_NAMES[atom], 1.0, TICK_S)


def outcome_at(simulation: Simulation, tick: int, purpose: Purpose, max_ticks: int) -> Outcome | None:
    """Say how the episode ends with the frame of a tick, at least 1, or None where it goes on; see `outcome_of`.

    Frame 0 ends nothing.
    """
    timed_out = tick >= max_ticks
    # Looking for the victim renders; of a demonstration it only matters at the end.
    in_view = not simulation.collided and (purpose == "run" or timed_out) and simulation.victim_found()
    return outcome_of(collided=simulation.collided, in_view=in_view, purpose=purpose, timed_out=timed_out)

"""Tasks that need several drives: replaying the most frequent or the last drive fails."""

import math
from dataclasses import dataclass, replace
from typing import Any, Final

from schemas.rpc import ResetRequest
from services.experiments.evaluation.drives import drive, drive_of
from services.experiments.evaluation.plan import TEACHING_SEED
from services.experiments.evaluation.search import search
from services.simulator.opening import open_simulation
from services.simulator.sensors.camera import CameraSettings
from services.simulator.world.place import Pose
from services.simulator.world.route import route_length_m
from smal.evaluation.drivers import SmalDriver
from smal.features import FeatureSettings
from smal.teaching.mapping import learn

_NORTHWARDS = math.pi / 2.0
_SOUTHWARDS = -math.pi / 2.0


@dataclass(frozen=True)
class TaughtLeg:
    """One taught drive: start, victim, name of the goal, and places on the way."""

    start: Pose
    victim: Pose
    goal: str
    via: tuple[tuple[float, float], ...] = ()


@dataclass(frozen=True)
class SeveralDrivesTask:
    """Taught drives and the goal to find after them; ``meaning`` describes the task."""

    meaning: str
    taught: tuple[TaughtLeg, ...]
    start: Pose
    goal: str
    victim: Pose


# Places of the world terrace, metres east and north: two corners of a block, and one between.
_WEST = Pose(3.0, 0.0, 0.0)
_SOUTH_WEST = Pose(0.0, -44.0, _NORTHWARDS)
_NORTH_WEST = Pose(0.0, 44.0, _SOUTHWARDS)
_NORTH = Pose(86.0, 53.6, 0.0)
_SOUTH = Pose(86.0, -53.6, 0.0)
_TO_NORTH = TaughtLeg(_WEST, _NORTH, "north")
_TO_SOUTH = TaughtLeg(_WEST, _SOUTH, "south")
_JOINED = (TaughtLeg(_SOUTH_WEST, _NORTH, "north"), TaughtLeg(_NORTH_WEST, _SOUTH, "south"))
# Through the far corner of the block.
_DETOUR = replace(_TO_NORTH, via=((119.0, 0.0), (119.0, 49.0)))

TASKS: Final = {
    "shorter way": SeveralDrivesTask(
        "taught a detour, then a shorter route to the same goal", (_DETOUR, _TO_NORTH), _WEST, "north", _NORTH
    ),
    "fork, to the left": SeveralDrivesTask(
        "taught two routes that fork; sent to the end of the first", (_TO_NORTH, _TO_SOUTH), _WEST, "north", _NORTH
    ),
    "fork, to the right": SeveralDrivesTask(
        "taught two routes that fork; sent to the end of the second", (_TO_NORTH, _TO_SOUTH), _WEST, "south", _SOUTH
    ),
    "joined, northwards": SeveralDrivesTask(
        "taught two routes that share a stretch; sent from the start of one to the end of the "
        "other",
        _JOINED, _NORTH_WEST, "north", _NORTH,
    ),
    "joined, southwards": SeveralDrivesTask("the same in the other direction", _JOINED, _SOUTH_WEST, "south", _SOUTH),
}  # fmt: skip


def run_task(
    world: str, camera: CameraSettings, features: FeatureSettings, name: str, seeds: range
) -> dict[str, Any]:
    """Teach a task and run it with each seed; return outcomes, driven and taught lengths (m)."""
    task = TASKS[name]
    made = []
    for number, one in enumerate(task.taught):
        there = open_simulation(world, camera, task=(one.start, one.victim))
        made.append(drive(there, features, TEACHING_SEED + number, one.via))
    model = learn([
        replace(drive_of(each), name=f"{name} {number}", goal=one.goal)
        for number, (each, one) in enumerate(zip(made, task.taught, strict=True))
    ])  # fmt: skip
    simulation = open_simulation(world, camera, task=(task.start, task.victim))
    driver = SmalDriver(model, task.goal)
    patience = 3 * max(len(one["poses"]) for one in made)
    found = [
        search(
            simulation,
            driver,
            ResetRequest(seed=seed, purpose="run", max_ticks=patience, until_said=True),
        )
        for seed in seeds
    ]
    return {
        "outcomes": [one.outcome for one in found],
        "driven_m": [round(one.driven_m, 2) for one in found],
        "taught_m": [round(route_length_m(one["poses"][:, :2]), 2) for one in made],
    }

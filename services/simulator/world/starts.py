"""Where an episode begins: seeded start poses about the start, or beside the route for recoveries."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np
import shapely

from services.simulator.world.collision import obstacles_of
from services.simulator.world.place import Pose, World, WorldError
from services.simulator.world.route import plan_route

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from schemas.episode import Purpose

_JITTER_RAD: Final = math.radians(15)
_ASIDE_RAD: Final = math.radians(40)
_TRIES: Final = 1000


def sample_start(world: World, rng: np.random.Generator, purpose: Purpose) -> Pose:
    """Draw a free start pose.

    Parameters
    ----------
    world
        The world to start in.
    rng
        The source of chance; the same state gives the same pose.
    purpose
        `drive` and `run`: up to `Scale.start_m` (outdoors 1 m) east-west and north-south and 15 degrees off the
        world's start. `recovery`: beside a point of the route, uniform along it except for the last `Scale.last_m`
        (3 m), up to `Scale.aside_m` (1.5 m) aside and 40 degrees turned away.

    Raises
    ------
    WorldError
        No free pose was found in 1000 draws.
    """
    draw = _beside_route if purpose == "recovery" else _about_start
    for _ in range(_TRIES):
        pose = draw(world, rng)
        if pose is not None:
            return pose
    raise WorldError(f"{world.name}: no free start pose for purpose '{purpose}' in {_TRIES} draws")


def _about_start(world: World, rng: np.random.Generator) -> Pose | None:
    x, y, heading = (rng.uniform(-1.0, 1.0, 3) * (world.scale.start_m, world.scale.start_m, _JITTER_RAD)).tolist()
    start = world.start
    pose = Pose(start.x + x, start.y + y, math.remainder(start.heading + heading, math.tau))
    return pose if _reaches(world, pose, np.array([start.x, start.y])) else None


def _beside_route(world: World, rng: np.random.Generator) -> Pose | None:
    route = shapely.LineString(plan_route(world, (world.start.x, world.start.y)))
    along = rng.uniform(0.0, max(route.length - world.scale.last_m, 0.0))
    aside, turned = rng.uniform(-1.0, 1.0, 2) * (world.scale.aside_m, _ASIDE_RAD)
    here = shapely.get_coordinates(route.interpolate(along))[0]
    ahead = shapely.get_coordinates(route.interpolate(min(along + 0.1, route.length)))[0] - here
    direction = math.atan2(ahead[1], ahead[0])
    x, y = here + aside * np.array([-math.sin(direction), math.cos(direction)])
    pose = Pose(float(x), float(y), math.remainder(direction + turned, math.tau))
    return pose if _reaches(world, pose, here) else None


def _reaches(world: World, pose: Pose, anchor: NDArray[np.float64]) -> bool:
    """Return whether the pose is free and nothing stands between it and the place that it was drawn about."""
    leg = np.array([[(pose.x, pose.y), anchor]])
    # With room to turn, so that an episode does not begin with a collision.
    return bool(obstacles_of(world.place).are_clear(leg, world.scale.start_room_m)[0])

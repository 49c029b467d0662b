"""Drives of the scripted expert in this process, equal to those of `smal demonstrate`."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from schemas.episode import Purpose
from schemas.rpc import ResetRequest
from services.expert.driver import DRIVE_TICKS, RECOVERY_TICKS, RouteDriver
from services.kit.jpeg import decode_jpeg
from services.recordings.dataset import recorded_images
from services.robot.lockstep import PosedView, SteppedEpisode
from services.robot.messages import rounded
from services.simulator.lockstep import LockstepEpisode
from services.simulator.sensors.camera import FIELD_OF_VIEW_DEG, SimulatedView
from services.simulator.simulation import Simulation
from services.simulator.world.place import Pose as Spot
from services.simulator.world.route import plan_route
from smal.camera import Camera
from smal.features import FeatureSettings, extract
from smal.files.container import replacing
from smal.movement import Atom
from smal.teaching.demonstration import Demonstration

Via = Sequence[tuple[float, float]]
P = TypeVar("P", bound=PosedView)


def views_of_expert(
    simulation: Simulation, seed: int, via: Via = (), purpose: Purpose = "drive"
) -> Iterator[tuple[SimulatedView, Atom | None]]:
    """Drive with the expert through places; yield each view and its action.

    The last action is STOP at the victim, or None after a failure.
    """
    most_ticks = RECOVERY_TICKS if purpose == "recovery" else DRIVE_TICKS
    request = ResetRequest(seed=seed, purpose=purpose, driver="expert", max_ticks=most_ticks)
    episode = LockstepEpisode(simulation, request)
    here = (simulation.pose.x, simulation.pose.y)
    world = simulation.world
    route = []
    for place in via:
        route += plan_route(replace(world, victim=Spot(*place, 0.0)), here).tolist()[:-1]
        here = place
    route += plan_route(world, here).tolist()
    car = world.robot.drive.radius_m > 0.0
    yield from _followed(
        episode, RouteDriver(route, simulation.speed_m_s, simulation.found_m, car=car)
    )


def _followed(episode: SteppedEpisode[P], expert: RouteDriver) -> Iterator[tuple[P, Atom | None]]:
    """Drive an episode with the expert; yield as `views_of_expert`."""
    while True:
        view = episode.view
        x, y, heading = view.true_pose
        if episode.outcome is not None or expert.arrived(x, y):
            there = episode.outcome == "found" or (episode.outcome is None and episode.reached)
            yield view, Atom.STOP if there else None
            return
        velocity = expert.velocity(x, y, heading)
        yield view, Atom[velocity.atom().upper()]
        episode.step(velocity)


def drive(
    simulation: Simulation,
    features: FeatureSettings,
    seed: int,
    via: Via = (),
    purpose: Purpose = "drive",
) -> dict[str, NDArray[Any]]:
    """Drive with the expert and return the arrays for `drive_of`.

    Raises
    ------
    ValueError
        If the drive does not reach the victim.
    """
    views = views_of_expert(simulation, seed, via, purpose)
    return _arrays(views, features, seed, purpose, simulation.name)


def drive_in(
    episode: SteppedEpisode[P], name: str, features: FeatureSettings
) -> dict[str, NDArray[Any]]:
    """Drive an episode of any simulator with the expert along its route; return as `drive`.

    Parameters
    ----------
    episode
        Episode of a body that reports the route, the true pose and odometry.
    name
        Name of the world, for errors.
    features
        Features to extract from every image.

    Raises
    ------
    ValueError
        If the drive does not reach the goal.
    """
    kinematics = episode.kinematics
    expert = RouteDriver(
        episode.beginning.route,
        kinematics.speed_m_s,
        episode.beginning.found_m or 0.0,
        car=kinematics.radius_m > 0.0,
    )
    request = episode.request
    return _arrays(_followed(episode, expert), features, request.seed, request.purpose, name)


def _arrays(
    views: Iterator[tuple[P, Atom | None]],
    features: FeatureSettings,
    seed: int,
    purpose: Purpose,
    name: str,
) -> dict[str, NDArray[Any]]:
    rows = []
    reached = False
    for view, atom in views:
        reached = atom is not None
        if not reached and purpose == "drive":
            raise ValueError(
                f"the expert's drive with seed {seed} in {name} did not reach the victim"
            )
        if view.odometry is None:
            raise ValueError(f"{name}: the body has no odometry; a comparison needs it")
        rows.append(
            (
                extract(decode_jpeg(view.jpeg), features),
                atom or Atom.STOP,
                rounded(view.odometry)[:3],
                view.true_pose,
                view.jpeg,
            )
        )
    described, atoms, odometry, poses, jpegs = zip(*rows, strict=True)
    return {
        "seed": np.array(seed),
        "reached": np.array(reached),
        "recovery": np.array(purpose == "recovery"),
        "features": np.stack(described),
        "atoms": np.array(atoms, dtype=np.int8),
        "odometry": np.array(odometry),
        "poses": np.array(poses),
        "jpegs": np.frombuffer(b"".join(jpegs), dtype=np.uint8),
        "jpeg_ends": np.cumsum([len(jpeg) for jpeg in jpegs]),
    }


def drive_of(held: dict[str, NDArray[Any]]) -> Demonstration:
    """Convert arrays of `drive` to a demonstration; its true poses are ``held["poses"]``."""
    recovery = bool(held["recovery"])
    name = f"{'recovery' if recovery else 'drive'}-{held['seed']}"
    jpegs = [jpeg.tobytes() for jpeg in np.split(held["jpegs"], held["jpeg_ends"][:-1])]
    images = recorded_images(jpegs, name, decode_jpeg)
    return Demonstration(
        name,
        held["features"],
        held["atoms"],
        successful=bool(held["reached"]),
        recovery=recovery,
        images=images,
        odometry=held["odometry"],
        camera=Camera.of_field(FIELD_OF_VIEW_DEG),
    )


def save_arrays(path: Path, **arrays: NDArray[Any]) -> None:
    """Write arrays to a file (npz) atomically."""
    with replacing(path) as file:
        np.savez(file, **arrays)  # type: ignore[arg-type]


def load_arrays(path: Path) -> dict[str, NDArray[Any]]:
    """Read the arrays of a file, read-only; raise ValueError with its path if it is damaged."""
    try:
        with np.load(path, allow_pickle=False) as held:
            arrays = {name: held[name] for name in held.files}
    except (OSError, ValueError, EOFError, BadZipFile) as error:
        raise ValueError(f"{path}: cannot be read: {' '.join(str(error).split())}") from None
    for one in arrays.values():
        one.setflags(write=False)  # Several drivers in a process share the arrays.
    return arrays

"""Drives of the scripted expert in this process, as `smal demonstrate` records and `smal learn` reads them."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from schemas.rpc import ResetRequest
from services.expert.driver import DRIVE_TICKS, RouteDriver
from services.kit.jpeg import decode_jpeg
from services.recordings.dataset import RecordedImages
from services.robot.messages import rounded
from services.simulator.camera import SimulatedView
from services.simulator.lockstep import LockstepEpisode
from services.simulator.simulation import Simulation
from services.simulator.world.place import Pose as Spot
from services.simulator.world.route import plan_route
from smal.demonstration import Demonstration
from smal.features import FeatureSettings, extract
from smal.files.container import replacing
from smal.movement import Atom

Via = Sequence[tuple[float, float]]


@dataclass(frozen=True, eq=False)
class Drive:
    """One drive that teaches.

    Attributes
    ----------
    demonstration
        What `smal learn` would make of it, with images, as JPEG.
    poses
        (f, 3) float64, x, y in metres and heading in radians of every frame; the truth, which learning must not use.
    """

    demonstration: Demonstration
    poses: NDArray[np.float64]


def views_of_expert(simulation: Simulation, seed: int, via: Via = ()) -> Iterator[tuple[SimulatedView, Atom | None]]:
    """Have the expert drive to the victim, by way of some places; yield each view and what is done at it.

    The last view is that of the victim, with `Atom.STOP`; one at which the drive has failed has None.
    """
    request = ResetRequest(seed=seed, purpose="drive", driver="expert", max_ticks=DRIVE_TICKS)
    episode, expert = LockstepEpisode(simulation, request), _expert(simulation, via)
    while True:
        view = episode.view
        if episode.outcome is not None or expert.arrived(view.pose.x, view.pose.y):
            there = episode.outcome == "found" or (episode.outcome is None and episode.reached)
            yield view, Atom.STOP if there else None
            return
        key = expert.key(view.pose.x, view.pose.y, view.pose.heading)
        yield view, Atom[key.upper()]
        episode.step(key)


def _expert(simulation: Simulation, via: Via) -> RouteDriver:
    here, world, route = (simulation.pose.x, simulation.pose.y), simulation.world, []
    for place in via:
        route += plan_route(replace(world, victim=Spot(*place, 0.0)), here).tolist()[:-1]
        here = place
    route += plan_route(world, here).tolist()
    return RouteDriver(route, simulation.speed_m_s, simulation.found_m)


def drive(simulation: Simulation, features: FeatureSettings, seed: int, via: Via = ()) -> Drive:
    """Have the expert drive once.

    Raises
    ------
    ValueError
        It did not reach the victim: `smal learn` leaves out such a drive.
    """
    views, poses, jpegs, odometry = [], [], [], []
    atoms: list[Atom] = []
    for view, atom in views_of_expert(simulation, seed, via):
        if atom is None:
            raise ValueError(f"the expert's drive with seed {seed} in {simulation.name} did not reach the victim")
        views.append(extract(view.image, features))
        poses.append((view.pose.x, view.pose.y, view.pose.heading))
        odometry.append(rounded(view.odometry)[:3])
        jpegs.append(view.jpeg)
        atoms.append(atom)
    focal = simulation.focal_px / view.image.shape[1]
    made = np.array(atoms, dtype=np.int8)
    return _drive(f"drive-{seed}", np.stack(views), made, np.array(odometry), np.array(poses), jpegs, focal)


def _drive(
    name: str, features: NDArray[np.float32], atoms: NDArray[np.int8], odometry: NDArray[np.float64],
    poses: NDArray[np.float64], jpegs: list[bytes], focal: float,
) -> Drive:  # fmt: skip
    images = RecordedImages(jpegs, name, decode_jpeg)
    return Drive(Demonstration(name, features, atoms, images=images, odometry=odometry, focal=focal), poses)


def save_drive(path: Path, one: Drive) -> None:
    """Write a drive of `drive` to a file (npz) that is there only when it is complete."""
    what = one.demonstration
    assert isinstance(what.images, RecordedImages)  # noqa: S101 - those of `drive` are
    assert what.odometry is not None  # noqa: S101
    jpegs = what.images.recorded
    save_arrays(
        path,
        meta=np.frombuffer(json.dumps([what.name, what.focal]).encode(), dtype=np.uint8),
        features=what.features,
        atoms=what.atoms,
        odometry=what.odometry,
        poses=one.poses,
        jpegs=np.frombuffer(b"".join(jpegs), dtype=np.uint8),
        jpeg_ends=np.cumsum([len(jpeg) for jpeg in jpegs]),
    )


def load_drive(path: Path) -> Drive:
    """Read a drive."""
    held = load_arrays(path)
    name, focal = json.loads(held["meta"].tobytes())
    jpegs = [jpeg.tobytes() for jpeg in np.split(held["jpegs"], held["jpeg_ends"][:-1])]
    return _drive(name, held["features"], held["atoms"], held["odometry"], held["poses"], jpegs, focal)


def save_arrays(path: Path, **arrays: NDArray[np.generic]) -> None:
    """Write arrays to a file (npz) that is there only when it is complete."""
    with replacing(path) as file:
        np.savez(file, **arrays)  # type: ignore[arg-type]


def load_arrays(path: Path) -> dict[str, NDArray[Any]]:
    """Read the arrays of a file.

    Raises
    ------
    ValueError
        It cannot be read; the text names it.
    """
    try:
        with np.load(path, allow_pickle=False) as held:
            return {name: held[name] for name in held.files}
    except (OSError, ValueError, EOFError, BadZipFile) as error:
        raise ValueError(f"{path}: cannot be read: {' '.join(str(error).split())}") from None

"""Drives of the scripted expert in this process, as `smal demonstrate` and `smal learn` would record and use them."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from schemas.rpc import ResetRequest
from services.expert.driver import DRIVE_TICKS, RouteDriver
from services.kit.jpeg import decode_jpeg, encode_jpeg
from services.recordings.dataset import RecordedImages
from services.robot.messages import rounded
from services.simulator.lockstep import LockstepEpisode
from services.simulator.simulation import Simulation
from services.simulator.world.place import Pose as Spot
from services.simulator.world.route import plan_route
from smal.demonstration import Demonstration
from smal.features import FeatureSettings, extract
from smal.files.container import replacing
from smal.movement import Atom


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

    @classmethod
    def of(
        cls,
        name: str,
        features: NDArray[np.float32],
        atoms: NDArray[np.int8],
        jpegs: list[bytes],
        odometry: NDArray[np.float64],
        focal: float,
        poses: NDArray[np.float64],
    ) -> Drive:
        """Put together what is known of every frame."""
        images = RecordedImages(jpegs, name, decode_jpeg)
        return cls(Demonstration(name, features, atoms, images=images, odometry=odometry, focal=focal), poses)


def drive(
    simulation: Simulation, features: FeatureSettings, seed: int, via: Sequence[tuple[float, float]] = ()
) -> Drive | None:
    """Have the expert drive once.

    Parameters
    ----------
    simulation
        Where.
    features
        Of the demonstration; those that need depth are not made here.
    seed
        As in `smal demonstrate`.
    via
        Places that it leads by way of, metres, in order.

    Returns
    -------
    Drive or None
        None for what `smal learn` leaves out: a drive that did not reach the victim.
    """
    request = ResetRequest(seed=seed, purpose="drive", driver="expert", max_ticks=DRIVE_TICKS)
    episode = LockstepEpisode(simulation, request)
    expert = expert_of(simulation, via)
    views, poses, jpegs, ways = [], [], [], []
    atoms: list[Atom] = []
    while True:
        view = episode.view
        views.append(extract(view.image, features))
        poses.append((view.pose.x, view.pose.y, view.pose.heading))
        ways.append(rounded(view.odometry)[:3])
        jpegs.append(encode_jpeg(view.image))
        outcome = episode.outcome
        if outcome is None and expert.arrived(view.pose.x, view.pose.y):
            outcome = "found" if episode.reached else "aborted"
        if outcome is not None:
            break
        key = expert.key(*poses[-1])
        atoms.append(Atom[key.upper()])
        episode.step(key)
    if outcome != "found":
        return None
    # With the victim found the robot stops.
    made = np.array([*atoms, Atom.STOP], dtype=np.int8)
    focal = simulation.focal_px / episode.view.image.shape[1]
    return Drive.of(f"drive-{seed}", np.stack(views), made, jpegs, np.array(ways), focal, np.array(poses))


def expert_of(simulation: Simulation, via: Sequence[tuple[float, float]] = ()) -> RouteDriver:
    """Return who drives from where the robot is to the victim, by way of some places."""
    here, world, route = (simulation.pose.x, simulation.pose.y), simulation.world, []
    for place in via:
        route += plan_route(replace(world, victim=Spot(*place, 0.0)), here).tolist()[:-1]
        here = place
    route += plan_route(world, here).tolist()
    return RouteDriver(route, simulation.speed_m_s, simulation.found_m)


def save_drive(path: Path, one: Drive, features: FeatureSettings) -> None:
    """Write a drive to a file (npz); an existing one is replaced only when the new one is complete."""
    what = one.demonstration
    if not isinstance(what.images, RecordedImages) or what.odometry is None:
        raise TypeError(f"{path}: the drive was not made here")
    meta = {"fingerprint": features.fingerprint, "name": what.name, "focal": what.focal}
    with replacing(path) as file:
        np.savez(
            file,
            meta=np.frombuffer(json.dumps(meta).encode(), dtype=np.uint8),
            features=what.features,
            atoms=what.atoms,
            odometry=what.odometry,
            poses=one.poses,
            jpegs=np.frombuffer(b"".join(what.images.recorded), dtype=np.uint8),
            jpeg_ends=np.cumsum([len(jpeg) for jpeg in what.images.recorded]),
        )


def load_drive(path: Path, features: FeatureSettings) -> Drive:
    """Read a drive.

    Raises
    ------
    ValueError
        The file holds none, or its features are others than those asked for; its text names the file.
    """
    try:
        with np.load(path, allow_pickle=False) as held:
            meta = json.loads(held["meta"].tobytes())
            if meta["fingerprint"] != features.fingerprint:
                raise ValueError("its drive has other features than are wanted")
            jpegs = [jpeg.tobytes() for jpeg in np.split(held["jpegs"], held["jpeg_ends"][:-1])]
            arrays = [held[name] for name in ("features", "atoms", "odometry", "poses")]
            return Drive.of(meta["name"], arrays[0], arrays[1], jpegs, arrays[2], meta["focal"], arrays[3])
    except (OSError, KeyError, ValueError, EOFError, TypeError, BadZipFile) as error:
        text = str(error).replace("\n", " ")
        raise ValueError(f"{path}: no drive can be read from it: {text}") from None

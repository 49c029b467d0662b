"""Drives of the scripted expert in this process, as `smal demonstrate` and `smal learn` would record and use them."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from schemas.episode import Purpose
from schemas.rpc import ResetRequest
from services.expert.driver import DRIVE_TICKS, RECOVERY_TICKS, RouteDriver
from services.kit.jpeg import decode_jpeg, encode_jpeg
from services.recordings.dataset import RecordedImages
from services.robot.messages import rounded
from services.simulator.lockstep import LockstepEpisode
from services.simulator.simulation import Simulation
from services.simulator.world.place import Pose as Spot
from services.simulator.world.route import plan_route
from smal.action_space import Atom
from smal.container import replacing
from smal.evaluation.baselines.thumbnails import thumbnail
from smal.features import FeatureSettings, extract
from smal.learning import Demonstration


@dataclass(frozen=True, eq=False)
class Drive:
    """One drive that teaches, with what an experiment needs beside it.

    Attributes
    ----------
    demonstration
        What `smal learn` would make of it; with images, as JPEG, only where it reached the goal: others add nothing to
        the map of views.
    poses
        (f, 3) float64, x, y in metres and heading in radians of every frame; the truth, which learning must not use.
    thumbnails
        (f, 48, 64, 3) uint8 RGB, or None where they were not asked for.
    """

    demonstration: Demonstration
    poses: NDArray[np.float64]
    thumbnails: NDArray[np.uint8] | None = None


def drive(
    simulation: Simulation,
    features: FeatureSettings,
    seed: int,
    purpose: Purpose,
    *,
    thumbnails: bool = False,
    via: Sequence[tuple[float, float]] = (),
) -> Drive | None:
    """Have the expert drive once.

    Parameters
    ----------
    simulation
        Where.
    features
        Of the demonstration; those that need depth are not made here.
    seed, purpose
        As in `smal demonstrate`: "drive" for a whole one, "recovery" for a short one that begins off the route.
    thumbnails
        Whether to keep small images.
    via
        Places that it leads by way of, metres, in order.

    Returns
    -------
    Drive or None
        None for what `smal learn` leaves out: a collision, or a whole drive that did not reach the victim.
    """
    max_ticks = RECOVERY_TICKS if purpose == "recovery" else DRIVE_TICKS
    request = ResetRequest(seed=seed, purpose=purpose, driver="expert", max_ticks=max_ticks)
    episode = LockstepEpisode(simulation, request)
    expert = expert_of(simulation, via)
    views, small, poses, jpegs, ways = [], [], [], [], []
    atoms: list[Atom] = []
    while True:
        view = episode.view
        views.append(extract(view.image, features))
        poses.append((view.pose.x, view.pose.y, view.pose.heading))
        ways.append(rounded(view.odometry)[:3])
        jpegs.append(encode_jpeg(view.image))
        if thumbnails:
            small.append(thumbnail(view.image))
        outcome = episode.outcome
        if outcome is None and expert.arrived(view.pose.x, view.pose.y):
            outcome = "found" if episode.reached else "aborted"
        if outcome is not None:
            break
        key = expert.key(*poses[-1])
        atoms.append(Atom[key.upper()])
        episode.step(key)
    if outcome == "collision" or (purpose == "drive" and outcome != "found"):
        return None
    if outcome == "found":
        # With the victim found the robot stops; any other end only says that nobody watched any more.
        atoms.append(Atom.STOP)
    frames = len(atoms)
    if not frames:
        return None
    return Drive(
        Demonstration(
            name=f"{purpose}-{seed}",
            features=np.stack(views[:frames]),
            atoms=np.array(atoms, dtype=np.int8),
            successful=outcome == "found",
            recovery=purpose == "recovery",
            images=RecordedImages(jpegs[:frames], f"{purpose}-{seed}", decode_jpeg) if outcome == "found" else None,
            odometry=np.array(ways[:frames]),
            focal=simulation.focal_px / view.image.shape[1],
        ),
        np.array(poses[:frames]),
        np.stack(small[:frames]) if thumbnails else None,
    )


def expert_of(simulation: Simulation, via: Sequence[tuple[float, float]] = ()) -> RouteDriver:
    """Return who drives from where the robot is to the victim, by way of some places."""
    here, world, route = (simulation.pose.x, simulation.pose.y), simulation.world, []
    for place in via:
        route += plan_route(replace(world, victim=Spot(*place, 0.0)), here).tolist()[:-1]
        here = place
    route += plan_route(world, here).tolist()
    return RouteDriver(route, simulation.speed_m_s, simulation.found_m)


def demonstrate(
    simulation: Simulation,
    features: FeatureSettings,
    drives: int,
    recoveries: int,
    seed: int = 1,
    *,
    thumbnails: bool = False,
    progress: Callable[[int], None] = lambda _done: None,
) -> list[Drive]:
    """Have the expert drive as `smal demonstrate --episodes DRIVES --recoveries RECOVERIES --seed SEED` has it.

    Parameters
    ----------
    simulation, features, thumbnails
        See `drive`.
    drives, recoveries
        How many of each; drive k of a kind has the seed `seed` + k.
    seed
        Of the first of each kind.
    progress
        Called with the number of drives that are done.

    Returns
    -------
    list of Drive
        Those that teach, whole drives first.
    """
    purposes: list[tuple[Purpose, int]] = [("drive", drives), ("recovery", recoveries)]
    requests = [(purpose, seed + k) for purpose, count in purposes for k in range(count)]
    teaching: list[Drive] = []
    for done, (purpose, number) in enumerate(requests, 1):
        made = drive(simulation, features, number, purpose, thumbnails=thumbnails)
        if made is not None:
            teaching.append(made)
        progress(done)
    return teaching


def save_drives(path: Path, drives: Sequence[Drive], features: FeatureSettings) -> None:
    """Write drives to a file (npz); an existing one is replaced only when the new one is complete."""
    meta = {
        "fingerprint": features.fingerprint,
        "names": [one.demonstration.name for one in drives],
        "successful": [one.demonstration.successful for one in drives],
        "recovery": [one.demonstration.recovery for one in drives],
        "focal": [one.demonstration.focal for one in drives],
        "thumbnails": all(one.thumbnails is not None for one in drives),
    }
    arrays: dict[str, Any] = {"meta": np.frombuffer(json.dumps(meta).encode(), dtype=np.uint8)}
    for number, one in enumerate(drives):
        arrays[f"features_{number}"] = one.demonstration.features
        arrays[f"atoms_{number}"] = one.demonstration.atoms
        arrays[f"odometry_{number}"] = one.demonstration.odometry
        arrays[f"poses_{number}"] = one.poses
        if isinstance(one.demonstration.images, RecordedImages):
            jpegs = one.demonstration.images.recorded
            arrays[f"jpegs_{number}"] = np.frombuffer(b"".join(jpegs), dtype=np.uint8)
            arrays[f"jpeg_ends_{number}"] = np.cumsum([len(jpeg) for jpeg in jpegs])
        if meta["thumbnails"] and one.thumbnails is not None:
            arrays[f"thumbnails_{number}"] = one.thumbnails
    with replacing(path) as file:
        np.savez(file, **arrays)


def load_drives(path: Path, features: FeatureSettings) -> list[Drive]:
    """Read drives.

    Raises
    ------
    ValueError
        The file holds none, or their features are others than those asked for; its text names the file.
    """
    try:
        with np.load(path, allow_pickle=False) as held:
            meta = json.loads(held["meta"].tobytes())
            if meta["fingerprint"] != features.fingerprint:
                raise ValueError("its drives have other features than are wanted")
            return list(_drives(held, meta))
    except (OSError, KeyError, ValueError, EOFError, TypeError, BadZipFile) as error:
        text = str(error).replace("\n", " ")
        raise ValueError(f"{path}: no drives can be read from it: {text}") from None


def _drives(held: np.lib.npyio.NpzFile, meta: dict[str, list[Any]]) -> Iterator[Drive]:
    rows = zip(meta["names"], meta["successful"], meta["recovery"], meta["focal"], strict=True)
    for number, (name, successful, recovery, focal) in enumerate(rows):
        demonstration = Demonstration(
            str(name),
            held[f"features_{number}"],
            held[f"atoms_{number}"],
            bool(successful),
            bool(recovery),
            _images(held, number, str(name)),
            held[f"odometry_{number}"],
            focal=focal,
        )
        small = held[f"thumbnails_{number}"] if meta["thumbnails"] else None
        yield Drive(demonstration, held[f"poses_{number}"], small)


def _images(held: np.lib.npyio.NpzFile, number: int, name: str) -> RecordedImages | None:
    if f"jpegs_{number}" not in held:
        return None
    jpegs = np.split(held[f"jpegs_{number}"], held[f"jpeg_ends_{number}"][:-1])
    return RecordedImages([jpeg.tobytes() for jpeg in jpegs], name, decode_jpeg)

"""A service as its own process, and the messages that the chain of services exchanges."""

import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from schemas.array import Float32Array
from schemas.base import Message
from schemas.camera import CompressedImage
from schemas.command import Command
from schemas.motion import Odometry
from schemas.observation import Observation
from schemas.state import State
from services.kit.jpeg import decode_jpeg, encode_jpeg
from services.kit.model_service import LoadedModel
from services.table import SERVICES
from smal.features import FeatureSettings, extract
from smal.movement import Atom
from smal.paper.learning import LearningSettings, learn
from smal.teaching.demonstration import Demonstration
from tests import corridor
from tests.corridor import Pose

FEATURES = FeatureSettings()
LENGTH = 3


def picture(place: int) -> np.ndarray:
    """Return the 48x64 image of a place: a coarse random pattern that belongs to it alone."""
    coarse = np.random.default_rng(place).integers(0, 255, (6, 8, 3), dtype=np.uint8)
    return np.kron(coarse, np.ones((8, 8, 1), dtype=np.uint8))


def image(tick: int, place: int | None = None, episode: str = "e") -> CompressedImage:
    """Return the camera frame of a tick, taken at a place (by default the one of that number)."""
    pixels = picture(tick if place is None else place)
    height, width, _ = pixels.shape
    return CompressedImage(
        robot="rescuebot",
        episode=episode,
        tick=tick,
        stamp_ns=tick,
        width=width,
        height=height,
        data=encode_jpeg(pixels),
    )


def observation(tick: int, place: int | None = None, episode: str = "e") -> Observation:
    """Return the observation of `image`."""
    vector = extract(decode_jpeg(image(tick, place, episode).data), FEATURES)
    return Observation.after(
        image(tick, place, episode),
        fingerprint=FEATURES.fingerprint,
        features=Float32Array.from_numpy(vector),
    )


def seen(tick: int, pose: Pose | None = None, episode: str = "e") -> Observation:
    """Return the observation at a pose in the corridor, by default where it was taught at that tick."""
    vector = extract(corridor.view(*(pose or corridor.pose(tick))), corridor.FEATURES)
    return Observation.after(
        image(tick, 0, episode),
        fingerprint=corridor.FEATURES.fingerprint,
        features=Float32Array.from_numpy(vector),
    )


def wheels(tick: int, pose: Pose | None = None, episode: str = "e") -> Odometry:
    """Return the odometry at a pose in the corridor, by default where it was taught at that tick."""
    x_m, y_m, heading_rad = pose or corridor.pose(tick)
    return Odometry.after(
        image(tick, 0, episode),
        x_m=x_m,
        y_m=y_m,
        heading_rad=heading_rad,
        speed_m_s=2.0,
        turn_rate_rad_s=0.0,
    )


def identity(model: Path) -> str:
    """Return the model's name in states: the beginning of the checksum of its file."""
    return model.read_bytes()[-32:].hex()[:16]


def state(tick: int, model: Path | None, episode: str = "e", **fields: object) -> State:
    """Return a state of a model, or an idle one."""
    header = Message(robot="rescuebot", episode=episode, tick=tick, stamp_ns=tick * 100_000_000)
    named = {"status": "idle"} if model is None else {"model": identity(model)}
    return State.after(header, **named, **fields)


def with_model(service: Any, model: Path) -> Any:
    """Have a service load a model; return the service."""
    service.load(LoadedModel.read(model))
    return service


def command(tick: int, robot: str = "rescuebot", source: str = "teleop") -> Command:
    """Return a command to turn left."""
    header = {"robot": robot, "episode": "e", "tick": tick, "stamp_ns": 0}
    return Command.model_validate(header | {"source": source, "atom": "left"})


def save_model(path: Path, frames: int = 18) -> Path:
    """Learn a corridor of places 0, 1, 2, ... that is driven forward, with one turn at place 9.

    By the paper's scheme: it has no images. ``tests.corridor`` has a model with a map of views.
    """
    vectors = np.stack([extract(picture(place), FEATURES) for place in range(frames)])
    atoms = np.full(frames, Atom.FORWARD, dtype=np.int8)
    atoms[9] = Atom.LEFT
    model = learn(
        [Demonstration("drive", vectors, atoms)], LearningSettings(sequence_length=LENGTH)
    )
    model.save(path)
    return path


@contextmanager
def process(service: str, endpoint: str, *flags: str) -> Iterator[subprocess.Popen[str]]:
    """Run a service as a process; it must end with status 0 at SIGTERM."""
    child = subprocess.Popen(
        [sys.executable, *SERVICES[service].command, "--router", endpoint, *flags],
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        yield child
    finally:
        child.send_signal(signal.SIGTERM)
        try:
            status = child.wait(100.0)
        finally:
            child.kill()
    assert status == 0, child.stderr.read() if child.stderr else ""

"""``Stored.load``; an input is a file without its checksum, which is made right (a wrong one is refused before all)."""

from __future__ import annotations

import hashlib
import json
import random
import struct
from collections.abc import Callable
from typing import Any

import numpy as np

from services.experiments.showing.summary import lines
from services.experiments.showing.ways import Ways
from smal.features import Centering, FeatureSettings
from smal.files import container
from smal.files.container import ModelError
from smal.files.stored import FORMAT_VERSION, Stored
from smal.filter import Filter
from smal.model import Model
from smal.movement import Movement
from smal.paper.model import Model as PaperModel
from smal.paper.transitions import NO_ACTION, learn_transitions
from smal.planning import Planner
from smal.virtual_views import TURNS_DEG
from smal.visual_map import VisualMap
from tests.fuzz.targets import check_line, scratch
from tests.fuzz.trees import changed

_FIXED = struct.Struct("<8sIQ")
_CHECKSUM_BYTES = 32


def seeds() -> list[bytes]:
    path = scratch.folder() / "seed.smal"
    found = []
    for one in (smallest_model(), smallest_map()):
        one.save(path)
        found.append(path.read_bytes()[:-_CHECKSUM_BYTES])
    path.unlink()
    return found


def smallest_model() -> PaperModel:
    """By the paper's scheme: two states of one frame each, one drive from the one to the other."""
    settings = FeatureSettings(("color",), (1.0,))
    stream, action = np.array([0, 1], np.int32), np.array([0, 0], np.int32)
    return PaperModel(
        feature_settings=settings,
        mean=np.zeros(settings.size, np.float32),
        sequence_length=1,
        lambda1=0.1,
        lambda2=0.1,
        templates=np.zeros((settings.size, 2), np.float32),
        actions=np.zeros((1, 1), np.int8),
        state_streams=(stream,),
        atoms=(np.zeros(2, np.int8),),
        names=("drive-1",),
        successful=(True,),
        recovery=(False,),
        transitions=learn_transitions((stream,), (action,), (True,), 2),
        reward=np.zeros(2),
        policy=np.array([0, NO_ACTION], np.int32),
        value=np.zeros(2),
        gamma=0.9,
    )


def smallest_map() -> Model:
    """Two keyframes a metre apart, and one component."""
    settings = FeatureSettings(("color",), (1.0,))
    mapped = VisualMap(
        poses=np.array([(0.0, 0.0, 0.0), (1.0, 0.0, 0.0)]),
        drives=np.zeros(2, np.int32),
        keyframes=np.array([0, 1], np.int32),
        basis=np.eye(settings.size, 1, dtype=np.float32),
        views=np.ones((2, 3, TURNS_DEG.size, 1), np.float32),
        aside=0.4,
        correlation_length=1.0,
        correlation_rad=0.2,
        kappa=10.0,
        outlier_cosine=0.3,
        alike_cosine=0.5,
        movements=np.array([(0.0, 0.0), (1.0, 0.0), (-1.0, 0.0), (0.0, 0.1), (0.0, -0.1)]),
        tick_s=0.1,
        odometry=True,
        scene=np.ones(3),
        goals=("victim",),
        names=(("drive-1",),),
    )
    return Model(Centering(np.zeros(settings.size, np.float32), settings), mapped)


def run(data: bytes) -> bool:
    path = scratch.file_of(data + hashlib.sha256(data).digest(), "x.smal")
    try:
        model = Stored.load(path)
    except ModelError as error:
        check_line(error)
        return False
    assert model.checksum == hashlib.sha256(data).hexdigest()
    assert isinstance(model, Model | PaperModel)
    assert all(line.isprintable() for line in lines(model, path.name, len(data)))
    if isinstance(model, Model):
        follow(model)
        assert np.isfinite(Ways(model.mapped).poses).all()
    else:
        assert model.templates.shape == (model.feature_settings.size, model.states * model.sequence_length)
    return True


def follow(model: Model) -> None:
    """Have the filter and the planner use the map: what was accepted must bear it."""
    views, planner = Filter(model.mapped, model.centering), Planner(model.mapped)
    for _ in range(2):
        belief = views.observe(np.ones(model.feature_settings.size, np.float32), Movement(0.5, 0.1))
        assert 0.0 <= belief.lost <= 1.0
        planner.decide(belief.summary(64))


def mutate(data: bytes, rng: random.Random) -> bytes | None:
    """Change the header's JSON, and bring the arrays to what it says where they differ in length only."""
    try:
        magic, version, size = _FIXED.unpack_from(data)
        header: Any = changed(json.loads(data[_FIXED.size : _FIXED.size + size]), rng)
        text = json.dumps(header, default=repr).encode()
    except (ValueError, struct.error, RecursionError, OverflowError):
        return None
    if rng.random() < 0.02:
        text = b"[" * 100_000
    body = data[_FIXED.size + size :]
    if version != FORMAT_VERSION or rng.random() < 0.1:
        body = body[: rng.randrange(len(body) + 1)]
    return _FIXED.pack(magic, FORMAT_VERSION, len(text)) + text + body


def with_arrays(data: bytes, change: Callable[[dict[str, np.ndarray]], None]) -> bytes:
    """Return an input with other arrays, and a header that tells their types and shapes."""
    path = scratch.file_of(data + hashlib.sha256(data).digest(), "x.smal")
    with path.open("rb") as file:
        meta, arrays, _ = container.read(file, path.name, FORMAT_VERSION)
    change(arrays)
    container.write(path, FORMAT_VERSION, meta, arrays)
    return path.read_bytes()[:-_CHECKSUM_BYTES]


def with_meta(data: bytes, change: Callable[[dict[str, Any]], dict[str, Any]]) -> bytes:
    """Return an input with another header, the arrays as they were."""
    magic, version, size = _FIXED.unpack_from(data)
    header = json.loads(data[_FIXED.size : _FIXED.size + size])
    text = json.dumps(header | {"meta": change(header["meta"])}).encode()
    return _FIXED.pack(magic, version, len(text)) + text + data[_FIXED.size + size :]

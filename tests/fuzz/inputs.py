"""Small valid files for the fuzzer to begin with."""

import atexit
import hashlib
import json
import os
import shutil
import tempfile
from collections.abc import Callable
from functools import cache
from io import BytesIO
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from mcap.writer import CompressionType, Writer

from schemas.base import Strict
from services.recordings.sink import partial_of
from services.recordings.writer import EpisodeWriter
from smal.camera import TURNS_DEG, Camera, Scene
from smal.features import Centering, FeatureSettings
from smal.files import container
from smal.files.stored import FORMAT_VERSION
from smal.likelihood import GRID, SHARES
from smal.map import VisualMap
from smal.model import Model
from smal.paper.model import PaperModel
from smal.paper.transitions import NO_ACTION, learn_transitions
from tests.services.recordings.recorded_messages import applied, event, state

CHECKSUM_BYTES = 32
COLOR = FeatureSettings(("color",))


@cache
def scratch() -> Path:
    """Return a folder of this process's own, gone with the process."""
    made = Path(tempfile.mkdtemp(prefix="smal-fuzz-")).resolve()
    atexit.register(shutil.rmtree, made, ignore_errors=True)
    return made


def file_of(data: bytes, name: str) -> Path:
    path = scratch() / name
    path.write_bytes(data)
    return path


def image_payload(jpeg: bytes | None = None) -> bytes:
    """Return a recorded image of 8 by 8 pixels, or of other bytes."""
    if jpeg is None:
        jpeg = cv2.imencode(".jpg", np.full((8, 8, 3), 200, np.uint8))[1].tobytes()
    return bytes(
        CompressedImage(frame_id="camera/jpeg", data=jpeg, format="jpeg").SerializeToString()
    )


def image_of_size(pixels: int) -> bytes:
    """Return a small image that says that it has so many rows and columns."""
    jpeg = CompressedImage.FromString(image_payload()).data
    at = (
        jpeg.index(b"\xff\xc0") + 5
    )  # after the marker of the frame, its length and the bits of a sample
    return image_payload(jpeg[:at] + pixels.to_bytes(2, "big") * 2 + jpeg[at + 4 :])


def recording(
    compression: CompressionType = CompressionType.NONE, *, finished: bool = True
) -> bytes:
    """Return an episode of two frames, the first without an image; with one short schema."""
    started = event("e", 0, "started")
    ended = event("e", 1, "ended", "found")
    told = [(one.topic_name, one.tick, one.model_dump_json().encode())
            for one in (started, state("e", 0), applied("e", 0), ended)]  # fmt: skip
    told.insert(3, ("camera/jpeg", 1, image_payload()))
    file = BytesIO()
    channels = dict[str, int]()
    writer = Writer(file, compression=compression)
    writer.start(profile="", library="smal")
    schema = writer.register_schema("smal.Any", "jsonschema", b"{}")
    for topic, tick, payload in told:
        if topic not in channels:
            metadata = {"robot": "rescuebot", "episode": "e"}
            channels[topic] = writer.register_channel(
                f"smal/rescuebot/{topic}", "json", schema, metadata
            )
        writer.add_message(channels[topic], tick, payload, tick, tick)
        writer.flush()
    if finished:
        writer.finish()
    return file.getvalue()


def leftover() -> bytes:
    """Return what a recorder leaves that is killed."""
    writer = EpisodeWriter.begin(scratch(), event("left", 0, "started"))
    for message in (
        event("e", 0, "started"),
        *(one("e", k) for k in range(13) for one in (state, applied)),
    ):
        writer.write(message)
    try:
        writer.flush()
        return partial_of(writer.path).read_bytes()
    finally:
        writer.seal().unlink()


def smallest_model() -> PaperModel:
    """By the paper's scheme: two states of one frame each, one drive from the one to the other."""
    stream = np.array([0, 1], np.int32)
    action = np.array([0, 0], np.int32)
    return PaperModel(
        feature_settings=COLOR,
        mean=np.zeros(COLOR.size, np.float32),
        sequence_length=1,
        lambda1=0.1,
        lambda2=0.1,
        templates=np.zeros((COLOR.size, 2), np.float32),
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
    mapped = VisualMap(
        poses=np.array([(0.0, 0.0, 0.0), (1.0, 0.0, 0.0)]),
        drives=np.zeros(2, np.int32),
        keyframes=np.array([0, 1], np.int32),
        basis=np.eye(COLOR.size, 1, dtype=np.float32),
        views=np.ones((2, 3, TURNS_DEG.size, 1), np.int8),
        blank=np.zeros(1, np.float32),
        correlation_length=1.0,
        correlation_rad=0.2,
        log_ratio=np.tile(np.linspace(-3.0, 10.0, GRID.size), (SHARES.size, 1)),
        gamma=1.0,
        next_correlation=0.5,
        movements=np.array([(0.0, 0.0), (1.0, 0.0), (-1.0, 0.0), (0.0, 0.1), (0.0, -0.1)]),
        tick_s=0.1,
        odometry=True,
        scene=Scene(Camera(0.7), 1.0, 1.0),
        goals=("victim",),
        names=(("drive-1",),),
        size=(64, 48),
    )
    return Model(Centering(np.zeros(COLOR.size, np.float32), COLOR), mapped)


def model_bytes(model: Model | PaperModel) -> bytes:
    """Return a model's file without its checksum: a wrong one is refused before all else."""
    model.save(scratch() / "seed.smal")
    return (scratch() / "seed.smal").read_bytes()[:-CHECKSUM_BYTES]


def with_parts(
    data: bytes, change: Callable[[dict[str, Any], dict[str, np.ndarray]], None]
) -> bytes:
    """Return a model's file with another header or other arrays."""
    path = file_of(data + hashlib.sha256(data).digest(), "x.smal")
    with path.open("rb") as file:
        meta, arrays, _ = container.read(file, path.name, FORMAT_VERSION)
    change(meta, arrays)
    container.write(path, FORMAT_VERSION, meta, arrays)
    return path.read_bytes()[:-CHECKSUM_BYTES]


def request(cls: type[Strict]) -> bytes:
    """Make the plainest request of a class, with every field present and every list filled."""
    return json.dumps(_example(cls.model_json_schema())).encode()


def _example(schema: dict[str, Any]) -> Any:
    match schema:
        case {"enum": [first, *_]}:
            return first
        case {"anyOf": [first, *_]}:
            return _example(first)
        case {"properties": fields}:
            return {name: _example(field) for name, field in fields.items()}
        case {"additionalProperties": dict(values)}:
            return {"a": _example(values)}
        case {"prefixItems": items}:
            return [_example(item) for item in items]
        case {"items": item}:
            return [_example(item)]
    plain = {
        "string": "drive-1",
        "integer": max(1, schema.get("minimum", 1)),
        "number": 0.5,
        "boolean": True,
    }
    return plain.get(schema.get("type", "object"), {})


@cache
def root() -> Path:
    """Return a folder with files, a FIFO, and links in it and out of it."""
    made = scratch() / "root"
    (made / "a").mkdir(parents=True)
    for file in (made / "b.smal", made / "a" / "b.smal", made.parent / "b.smal"):
        file.write_bytes(b"x")
    os.mkfifo(made / "fifo")
    for link, target in (("in", "a"), ("up", ".."), ("etc", "/etc"), ("loop", "loop")):
        (made / link).symlink_to(target)
    return made

"""Every decoder of a stranger's bytes: what it begins with, and how it is run.

``run`` returns whether the input was accepted, or raises where the decoder broke its promise: that any bytes give
either a usable value or the documented exception with one clear line.
"""

import hashlib
import inspect
import itertools
import json
import re
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from mcap.writer import CompressionType
from pydantic import TypeAdapter, ValidationError

from schemas import rpc
from schemas.base import Strict
from schemas.codec import DecodeError, decode, describe, encode, encoding_of
from schemas.rpc import Failure, FolderName
from schemas.topics import TOPICS
from services.cli.listening import Sample
from services.experiments.showing.summary import lines
from services.experiments.showing.ways import Ways
from services.importers import run as importer
from services.importers.drive import ImportFailure, Tally
from services.importers.job import Format, ImportJob
from services.kit.errors import JobError
from services.kit.root import below, name_below, open_below
from services.recordings.encoding import decode_image
from services.recordings.leftover import LeftoverError, seal_leftover
from services.recordings.reader import read_recording
from services.recordings.repair import repair
from services.recordings.stream import RecordingError
from services.simulator.world.loading import WORLDS_FOLDER, Wishes, import_map, load_world
from services.simulator.world.place import WorldError
from smal.files.container import ModelError
from smal.files.stored import Stored
from smal.filter import Filter
from smal.model import Model
from smal.movement import Movement
from smal.planning import Planner
from tests.fuzz import inputs
from tests.schemas.messages import EXAMPLES, GOLDEN
from tests.services.importers import bags, sources

LONGEST_INPUT: Final = 100_000
CRASHERS: Final = Path(__file__).resolve().parent / "crashers"
_LONGEST_LINE: Final = 700
_MESSAGES: Final = list(dict.fromkeys(topic.message for topic in TOPICS.values()))
_REQUESTS: Final = [
    cls for _, cls in sorted(inspect.getmembers(rpc, inspect.isclass))
    if issubclass(cls, Strict) and cls.__module__ == rpc.__name__
]  # fmt: skip
_NAME: TypeAdapter[str] = TypeAdapter(FolderName)


class Target(NamedTuple):
    """Small and different inputs, the first of them valid; and the decoder."""

    seeds: Callable[[], list[bytes]]
    run: Callable[[bytes], bool]


def crashers_of(name: str) -> list[Path]:
    """Return the kept inputs that once broke a decoder."""
    return sorted((CRASHERS / name).glob("*"))


def check_line(error: BaseException | str) -> None:
    """Raise unless a text is one line that fits a log and moves no terminal."""
    text = str(error)
    assert text, "an error without words"
    assert text.isprintable(), f"not one clear line: {text[:2000]!r}"
    assert len(text) <= _LONGEST_LINE, f"not one clear line: {text[:2000]!r}"


def _message_seeds() -> list[bytes]:
    golden = json.loads(GOLDEN.read_text())
    whole = [
        bytes([number]) + bytes.fromhex(golden[cls.__name__]["hex"])
        for number, cls in enumerate(_MESSAGES)
    ]
    return whole + [
        bytes([number]) + encode(EXAMPLES[cls])[:40] for number, cls in enumerate(_MESSAGES)
    ]


def _message(data: bytes) -> bool:
    """Decode a message; the first byte of an input chooses its class."""
    cls = _MESSAGES[data[0] % len(_MESSAGES)] if data else _MESSAGES[0]
    try:
        message = decode(cls, data[1:], encoding_of(cls))
    except DecodeError as error:
        check_line(error)
        return False
    # Whatever was let in can be sent on, and means the same there.
    again = encode(message)
    assert decode(cls, again, encoding_of(cls)) == message
    assert encode(decode(cls, again, encoding_of(cls))) == again
    return True


def _request_seeds() -> list[bytes]:
    return [bytes([number]) + inputs.request(cls) for number, cls in enumerate(_REQUESTS)]


def _request(data: bytes) -> bool:
    """Validate a request or a reply; the first byte chooses the class."""
    cls = _REQUESTS[data[0] % len(_REQUESTS)] if data else _REQUESTS[0]
    try:
        message: Strict = cls.model_validate_json(data[1:])
        accepted = True
    except ValidationError as error:
        check_line(describe(error))
        message = Failure(error=describe(error))
        accepted = False
    # What was understood, and the reason why not, can be sent.
    assert type(message).model_validate_json(message.model_dump_json().encode()) == message
    return accepted


def _sample_seeds() -> list[bytes]:
    return [
        b"\n".join(
            [
                f"smal/{message.robot}/{message.topic_name}".encode(),
                encoding_of(cls).encode(),
                encode(message),
            ]
        )
        for cls, message in EXAMPLES.items()
    ]


def _sample(data: bytes) -> bool:
    """Say what `smal topic echo` says: an input is key, encoding and payload, a line each."""
    key, encoding, payload, *_ = [*data.split(b"\n", 2), b"", b""]
    sample = Sample(key.decode(errors="replace"), payload, encoding.decode(errors="replace"))
    # The line of a whole message is as long as its fields, of which the codec has checked every one.
    line = sample.line()
    assert line.isprintable()
    assert len(line) < 8000
    record = sample.record()
    if "error" in record:
        check_line(str(record["error"]))
    assert "\n" not in json.dumps(record, allow_nan=False)
    return "error" not in record


def _recording_seeds() -> list[bytes]:
    whole = [inputs.recording(compression) for compression in CompressionType]
    return [*whole, inputs.recording(finished=False), whole[0][:400]]


def _recording(data: bytes) -> bool:
    try:
        recording = read_recording(inputs.file_of(data, "e.mcap"))
    except RecordingError as error:
        check_line(error)
        return False
    assert any(episode.frames for episode in recording.episodes)
    for episode in recording.episodes:
        assert sum(piece.size for piece in episode.pieces()) <= len(episode.images)
    return True


def _leftover_seeds() -> list[bytes]:
    older = inputs.recording(finished=False)
    whole = inputs.leftover()
    return [whole, whole[:-7], whole + bytes(30), older, older[:-7], inputs.recording()]


def _leftover(data: bytes) -> bool:
    """Seal what was left: it becomes a recording that can be read, or stays as it was."""
    left = inputs.file_of(data, "e.mcap.partial")
    try:
        path = seal_leftover(left).path
        assert not left.exists()
        if path is None:
            return False
        assert not read_recording(path).truncated
    except (LeftoverError, RecordingError) as error:
        check_line(error)
        if isinstance(error, LeftoverError) and left.read_bytes() != data:
            raise
        return not left.exists()
    finally:
        for found in inputs.scratch().glob("e*.mcap*"):
            found.unlink()
    return True


def _repair(data: bytes) -> bool:
    """Repair: a recording without damage comes of it, or none at all."""
    path = inputs.file_of(data, "e.mcap")
    out = path.with_name("e-repaired.mcap")
    try:
        (before,), after = repair([path], out)
    except JobError as error:
        check_line(error)
        assert not out.exists()
        return False
    finally:
        out.unlink(missing_ok=True)
    assert path.read_bytes() == data
    for line in [*before.findings, *([] if after is None else after.findings)]:
        check_line(line)
    assert after is None or (after.state == "sealed" and not after.damage)
    return True


def _image_seeds() -> list[bytes]:
    return [inputs.image_payload(), inputs.image_of_size(32_700)]  # which would be 3 GB of pixels


def _image(data: bytes) -> bool:
    try:
        pixels = decode_image(data)
    except ValueError as error:
        check_line(error)
        return False
    assert pixels.shape[2:] == (3,)
    return True


def _model_seeds() -> list[bytes]:
    return [inputs.model_bytes(one) for one in (inputs.smallest_model(), inputs.smallest_map())]


def _model(data: bytes) -> bool:
    """Load a model; its checksum is made right. What was accepted must bear use."""
    path = inputs.file_of(data + hashlib.sha256(data).digest(), "x.smal")
    try:
        model = Stored.load(path)
    except ModelError as error:
        check_line(error)
        return False
    assert all(line.isprintable() for line in lines(model, path.name, len(data)))
    if not isinstance(model, Model):
        assert model.templates.shape == (
            model.feature_settings.size,
            model.states * model.sequence_length,
        )
        return True
    assert np.isfinite(Ways(model.mapped).poses).all()
    views = Filter(model.mapped, model.centering)
    planner = Planner(model.mapped)
    for _ in range(2):
        belief = views.observe(np.ones(model.feature_settings.size, np.float32), Movement(0.5, 0.1))
        assert 0.0 <= belief.lost <= 1.0
        planner.decide(belief.summary(64))
    return True


def _world_seeds() -> list[bytes]:
    yard = (WORLDS_FOLDER / "yard.osm").read_text()
    return [
        yard.encode(),
        yard.replace('"smal:role"', '"note"').encode(),
        re.sub(r"<bounds[^>]*>", "", yard).encode(),
    ]


def _world_file_seeds() -> list[bytes]:
    _, text = import_map(WORLDS_FOLDER / "yard.osm", inputs.scratch() / "seed.json", Wishes())
    return [text.encode(), *(path.read_bytes() for path in sorted(WORLDS_FOLDER.glob("*.json")))]


def _world(data: bytes, name: str) -> bool:
    """Load a world of a file of that name; its task lies inside it."""
    try:
        world = load_world(inputs.file_of(data, name))
    except WorldError as error:
        check_line(error)
        return False
    x_min, y_min, x_max, y_max = world.place.bounds
    assert all(
        x_min <= one.x <= x_max and y_min <= one.y <= y_max for one in (world.start, world.victim)
    )
    return True


def _name_seeds() -> list[bytes]:
    parts = ["b.smal", "a", "in", "up", "etc", "fifo", "loop", *(".", "..", "", " ", "~", "ä")]
    parts += ["x" * 300, "\0", "\\"]
    return [b"b.smal", *("/".join(pair).encode() for pair in itertools.product(parts, repeat=2))]


def _name(data: bytes) -> bool:
    """Open a file below a root: a name is refused in one line, or leads to nothing outside of it."""
    try:
        name = _NAME.validate_json(data if data[:1] == b'"' else b'"' + data + b'"')
    except ValidationError as error:
        check_line(describe(error))
        return False
    try:
        path = below(inputs.root(), name)
        assert path.is_relative_to(inputs.root())
        again = name_below(inputs.root(), path)
        assert again is not None
        assert below(inputs.root(), again) == path
        with open_below(inputs.root(), name) as file:
            assert file.read() == b"x"
    except OSError:
        return False
    return True


@dataclass
class Imported:
    """A source of ``smal import`` of which some text files are the input, one behind the other.

    Parquet and MP4 files are decoded by other people's C++, in a process of its own.
    """

    form: Format
    make: Callable[[Path], Path]
    files: tuple[str, ...]

    @cached_property
    def made(self) -> tuple[Path, bytes]:
        """Return the folder, and its files as one input."""
        folder = self.make(inputs.scratch() / self.form)
        return folder, b"\n\x1e\n".join((folder / name).read_bytes() for name in self.files)

    def seeds(self) -> list[bytes]:
        """Return a whole source, and one that ends early."""
        return [self.made[1], b"\n".join(self.made[1].splitlines()[:8])]

    def run(self, data: bytes) -> bool:
        """Import the source with these files."""
        for name, part in zip(
            self.files, [*data.split(b"\n\x1e\n"), *[b""] * len(self.files)], strict=False
        ):
            (self.made[0] / name).write_bytes(part)
        return _import(self.form, self.made[0])


def _import(form: Format, source: Path) -> bool:
    """Import, and say whether that was possible; what is said of it is lines, either way."""
    out = inputs.scratch() / "out"
    tally = Tally()
    out.mkdir(exist_ok=True)
    try:
        report = importer.run(
            ImportJob(format=form, path=str(source), folder=str(out), robot="burger"), tally
        )
    except ImportFailure as error:
        check_line(error)
        return False
    finally:
        shutil.rmtree(out)
        for line in tally.lines():
            check_line(line)
    assert report.ticks > 0
    return True


def _bag_seeds() -> list[bytes]:
    """Return bags of a third of a second: inputs are to be small."""
    found = []
    for kind, packed in (("mcap", False), ("mcap", True), ("db3", False)):
        folder = inputs.scratch() / f"{kind}{packed}"
        if not folder.exists():
            sources.rosbag2(folder, sqlite=kind == "db3", packed=packed, hundredths=31, raw=None)
        found += [path.read_bytes() for path in folder.rglob(f"*.{kind}")]
    old = inputs.scratch() / "old"
    if not old.exists():
        bags.old(old)
    return [*found, (old / "old.bag").read_bytes()]


def _bag(data: bytes) -> bool:
    kinds = {b"SQLite": "db3", b"#ROSBAG": "bag"}
    kind = next((kind for start, kind in kinds.items() if data.startswith(start)), "mcap")
    return _import("rosbag2", inputs.file_of(data, f"bag.{kind}"))


_TUB = Imported(
    "donkeycar", partial(sources.donkeycar, rate_hz=10.0), ("manifest.json", "catalog_0.catalog")
)
_TABLE = Imported("folder", partial(sources.csv_folder, rate_hz=10.0), ("drive.csv",))
_DATASET = Imported("lerobot", partial(sources.lerobot, version="v2.1", video=False, episodes=1, fps=10),
                    ("meta/info.json", "meta/episodes.jsonl"))  # fmt: skip

TARGETS: Final = {
    "messages": Target(_message_seeds, _message),
    "rpc": Target(_request_seeds, _request),
    "samples": Target(_sample_seeds, _sample),
    "recording": Target(_recording_seeds, _recording),
    "recovery": Target(_leftover_seeds, _leftover),
    "repair": Target(_leftover_seeds, _repair),
    "image": Target(_image_seeds, _image),
    "model": Target(_model_seeds, _model),
    "world": Target(_world_seeds, partial(_world, name="x.osm")),
    "world_file": Target(_world_file_seeds, partial(_world, name="x.json")),
    "names": Target(_name_seeds, _name),
    "tub": Target(_TUB.seeds, _TUB.run),
    "image_table": Target(_TABLE.seeds, _TABLE.run),
    "bag": Target(_bag_seeds, _bag),
    "dataset": Target(_DATASET.seeds, _DATASET.run),
}

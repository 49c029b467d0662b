"""Every mistake in a command is one line with the promised exit status, and leaves nothing behind."""

import os
import re
import struct
from collections.abc import Iterator
from pathlib import Path

import pytest

from services.recordings.sink import claim
from smal.files.stored import FORMAT_VERSION
from tests import corridor
from tests.services.chain import LENGTH, save_model
from tests.services.cli.conftest import Mistake
from tests.services.cli.test_learn import drive
from tests.services.exporters.recorded_drive import recording
from tests.services.importers.sources import donkeycar
from tests.services.recordings.test_recorder_files import record
from tests.services.simulator.map_text import block_of_houses

LONG = "r" * 31
RUN = "run --world yard --model"
DEMONSTRATE = "demonstrate --world yard"
LEARN = "paper learn --out new"
IMPORT = "import folder --out new"
EXPORT = "export folder --out new"
LAPS = "laps --out new"
WORLD = "world import map.osm --out new.json"

#: A model with options of ``run`` and ``up`` that do not fit it.
MODELS = [
    ("none.smal", "--model none.smal: not found"),
    ("text.smal", "text.smal"),
    ("newer.smal", f"format {FORMAT_VERSION + 1}"),
    ("mapped.smal --stride 2", "stride 2: the filter decides at every frame; for a stride"),
    ("mapped.smal --scheme paper", "scheme 'filter' of the model is not 'paper'"),
    ("mapped.smal --goal office", "the model has no goal 'office'; it has victim"),
    ("mapped.smal --modalities color", "--modalities color: the model was learned on"),
    ("paper.smal --scheme filter", "scheme 'paper' of the model is not 'filter'"),
    ("paper.smal --stride 4", f"stride must be 1 to the sequence length {LENGTH}, got 4"),
    (
        "paper.smal --goal victim",
        "goal 'victim': the paper's scheme always goes to the nearest goal",
    ),
]
UNREADABLE = ("text.smal", "newer.smal")  # A wrong content is a failed job, status 1.
#: Arguments separated by single spaces, exit status, and a pattern for the line.
MISTAKES = [
    ("mach", 2, "No such command 'mach'. Did you mean 'match'?"),
    ("run --seed 3", 2, "--model"),
    ("nonsense", 2, "nonsense"),
    ("run --model x --episodes 0", 2, "--episodes"),
    ("run --model x --scheme dream", 2, "--scheme"),
    ("demonstrate --camera big", 2, "--camera"),
    ("demonstrate --shake nan", 2, "--shake"),
    ("demonstrate --goal \n", 2, "--goal"),
    ("up --modalities smell", 2, "--modalities"),
    ("up --modalities hog,depth", 2, "recordings contain no depth images"),
    ("demonstrate --camera 160x120 --connect tcp/127.0.0.1:9", 2, "--camera"),
    ("demonstrate --world atlantis", 2, "atlantis.*campus"),
    (f"{DEMONSTRATE} --out file", 2, "--out"),
    ("up --robot A?B", 2, "--robot"),
    ("up --model none.smal", 2, "none.smal"),
    ("up --robots 33", 2, "--robots"),
    (f"up --robot {LONG} --robots 2", 2, "--robots"),
    ("up --scale recorder=2", 2, "--scale"),
    ("up --scale recognition=00", 2, "--scale"),
    ("up --scale recognition=10", 2, "--scale"),
    *(
        (f"{command} --world yard --model {model}", 1 if model in UNREADABLE else 2, line)
        for command in ("run", "up")
        for model, line in MODELS
    ),
    (f"{RUN} mapped.smal --json none/runs.json", 2, "--json none/runs.json"),
    (f"{RUN} mapped.smal --json full", 2, "--json full"),
    (f"{RUN} mapped.smal --json mapped.smal", 2, "--json mapped.smal"),
    (f"{RUN} mapped.smal --report file", 2, "--report file"),
    (f"{RUN} mapped.smal --record file/deeper", 2, "--record file/deeper"),
    (f"{IMPORT} no-such", 2, "no-such: not found"),
    (f"{IMPORT} x --goal \n", 2, "'--goal'"),
    (f"{IMPORT} x --robot Burger", 2, "'--robot'"),
    (f"{IMPORT} x --from 5 --to 5", 2, "--to 5: not after --from 5"),
    ("import donkeycar tub --out new --rotate 45", 2, "--rotate 45: unsupported; choose 90, 180"),
    ("import donkeycar tub --out new --turn-rate 0", 2, "turn_rate: 0 is invalid"),
    ("import donkeycar damaged-tub --out new", 1, "damaged-tub"),
    (f"{EXPORT} no-such", 2, "no-such: not found"),
    (f"{EXPORT} file", 1, "file: not an MCAP file"),
    (
        "export folder drives --out full",
        2,
        "--out full: already exists and is not empty; choose another name",
    ),
    (
        f"{EXPORT} living/drive.mcap.partial",
        1,
        "still being recorded; end the episode or stop the recorder",
    ),
    (f"{EXPORT} blind", 1, "blind.mcap: no camera frame"),
    (
        f"{EXPORT} lost",
        1,
        "episode lost: no odometry for the speed of forward; give it with --speed",
    ),
    (f"{LEARN} none", 2, "none: not found"),
    (f"{LEARN} drives --lambda2 inf", 2, "lambda2 must be finite and positive, got inf"),
    (f"{LEARN} drives --tau nan", 2, "--tau"),
    (f"{LEARN} drives --out empty.mcap/model.smal", 2, "--out empty.mcap: is a file"),
    (
        f"{LEARN} drives --json none/report.json",
        2,
        "--json none/report.json: folder none not found",
    ),
    (f"{LEARN} empty.mcap", 1, "empty.mcap: empty"),
    (f"{LEARN} failed.mcap", 1, "cannot learn from these recordings: "),
    ("learn drives --out new --length 1", 2, "--length"),
    *(
        (f"{learn} --modalities hog,depth", 2, "recordings contain no depth images; omit depth")
        for learn in ("learn drives --out new", f"{LEARN} drives")
    ),
    ("model show text.smal", 1, "not a SMAL model"),
    ("model show mapped.smal --recordings full", 2, "give --out too"),
    ("model show mapped.smal --recordings none --out full", 2, "not found"),
    ("model show mapped.smal --out file", 2, "is a file, not a folder"),
    ("evaluate --out file", 2, "is a file, not a folder"),
    ("evaluate --out new --report-only", 2, "folder not found"),
    (f"{LAPS} tub", 1, "whole laps"),
    (f"{LAPS} none", 2, "not found"),
    (f"{LAPS} full", 2, "no recording"),
    (f"{LAPS} damaged-tub", 1, "the manifest of a tub"),
    ("topic echo --count 0", 2, "--count"),
    ("topic hz --seconds nan", 2, "--seconds"),
    ("topic info stat", 2, "did you mean state?"),
    ("topic echo stat", 2, "did you mean state?"),
    ("topic hz stat", 2, "did you mean state?"),
    ("replay no-such.mcap", 2, "no-such.mcap: not found"),
    ("recording repair no-such.mcap", 2, "no-such.mcap: not found"),
    ("replay full", 2, "full: not a regular file"),
    ("match file file", 1, "nor a readable video"),
    ("world render atlantis --out new", 2, "atlantis.*campus"),
    ("demo --browser --connect tcp/127.0.0.1:9", 2, "--browser: unsupported with --connect"),
    ("demo --browser --runs 3", 2, "--runs: unsupported with --browser"),
    ("demo --secure full --out new", 2, "--secure full: requires --connect"),
    ("demonstrate --secure full --out new", 2, "--secure full: requires --connect"),
    ("run --model mapped.smal --secure full", 2, "--secure full: requires --connect"),
    ("up --robot-body none --world yard", 2, "--world: unsupported by --robot-body none"),
    ("up --robot-body none --camera 160x120", 2, "--camera: unsupported by --robot-body none"),
    (f"secure init keys --robot {LONG} --robots 2", 2, "--robots"),
    ("secure init keys --host ", 2, "--host"),
    ("secure init keys --host b\u00fccher.example", 2, "--host"),
    ("secure init keys --host a\nb", 2, "--host"),
    (f"secure init keys --host {'a' * 64}", 2, "--host"),
    ("secure check full", 2, "ca.pem"),
    ("secure renew full", 2, "ca.pem"),
    (f"{WORLD} --start nan,0,0", 2, "--start 'nan,0,0'"),
    (f"{WORLD} --radius 100", 2, "--around LAT,LON and --radius METRES: give both"),
    (f"{WORLD} --around 95,0 --radius 100", 2, "outside latitude -85 to 85"),
    (f"{WORLD} --around 0,0 --radius 100", 1, "the map has no buildings"),
    (
        f"{WORLD} --start=-60,-50,0 --victim=0,40",
        1,
        r"the victim at \(0.0, 40.0\) m stands in an obstacle",
    ),
    ("world import map.osm --out none/a.json", 2, "folder none not found"),
]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Give a folder with what the mistakes name."""
    here = tmp_path_factory.mktemp("mistakes")
    (here / "full").mkdir()
    for name in ("file", "full/file", "text.smal"):
        (here / name).write_text("words")
    (here / "empty.mcap").touch()
    save_model(here / "paper.smal")
    content = bytearray(corridor.save_model(here / "mapped.smal").read_bytes())
    content[8:12] = struct.pack("<I", FORMAT_VERSION + 1)
    (here / "newer.smal").write_bytes(content)
    recording(here / "drives")
    recording(here / "blind", "blind", images=False)
    recording(here / "lost", "lost", odometry=False)
    record(here, drive("failed", purpose="recovery", outcome="aborted"))
    donkeycar(here / "tub")
    (donkeycar(here / "damaged-tub") / "manifest.json").write_bytes(b"PK\x05\x06" + bytes(18))
    block_of_houses().write(here / "map.osm")
    lock = claim(recording(here / "living", outcome=None))
    yield here
    os.close(lock)


@pytest.mark.parametrize(("arguments", "status", "pattern"), MISTAKES)
def test_command_prints_one_line_when_its_use_is_wrong(
    arguments: str,
    status: int,
    pattern: str,
    folder: Path,
    mistake: Mistake,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(folder)
    before = sorted(folder.rglob("*"))
    assert re.search(pattern, mistake(status, *arguments.split(" ")))
    assert sorted(folder.rglob("*")) == before

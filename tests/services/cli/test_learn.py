"""``smal learn``: which recordings teach, what is said of the others, and a model at the end."""

import gc
import json
import shutil
import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from schemas.base import Message
from schemas.camera import CameraInfo, CompressedImage
from schemas.episode import Outcome, Purpose
from schemas.motion import Odometry
from services.cli.learn import learn
from services.cli.lessons import Lessons
from services.cli.paper import Settings
from services.cli.paper import learn as learn_paper
from services.kit.errors import JobError
from services.recordings.dataset import Teacher, find_recordings
from services.recordings.reader import read_recording
from services.recordings.writer import EpisodeWriter
from smal.camera import Camera
from smal.features import FeatureSettings
from smal.model import Model
from smal.paper.model import PaperModel
from smal.teaching.demonstration import DriveUse, whole_drives
from tests import corridor
from tests.services.recordings.recorded_messages import applied, event, header, seen
from tests.services.recordings.test_recorder_files import leave, record

FEATURES = corridor.FEATURES


def view(position: int) -> np.ndarray:
    return corridor.view(*odometry(position))


def odometry(position: int) -> tuple[float, float, float]:
    return corridor.STEP_M * position, 0.0, 0.0


def drive(
    name: str,
    first: int = 0,
    frames: int = 40,
    outcome: Outcome = "found",
    purpose: Purpose = "drive",
) -> list[Message]:
    """Drive along the corridor, two frames forward and one to the left, in turn."""
    messages: list[Message] = [event(name, 0, "started", purpose=purpose)]
    for tick in range(frames):
        messages += seen(header(name, tick), view(first + tick), odometry(first + tick))
        messages.append(applied(name, tick, atom="left" if tick % 3 == 2 else "forward"))
    if outcome == "found":
        messages.append(event(name, frames - 1, "victim_found", purpose=purpose))
    return [*messages, event(name, frames - 1, "ended", outcome, purpose=purpose)]


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("drives")
    for number in range(3):
        record(folder, drive(f"drive-{number}"))
    record(folder, drive("recovery-1", first=10, frames=20, outcome="timeout", purpose="recovery"))
    return folder


@pytest.fixture
def drives(recorded: Path, tmp_path: Path) -> Path:
    """Give a copy, which a test may change."""
    return Path(shutil.copytree(recorded, tmp_path / "drives"))


def teach(*paths: Path, features: FeatureSettings = FEATURES, **options: bool) -> Teacher:
    teacher = Teacher(features, shortest=5, **options)
    for path in find_recordings(paths):
        teacher.read(path)
    return teacher


def test_a_model_with_shared_states_is_learned(
    drives: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "models" / "corridor.smal"
    report = tmp_path / "report.json"
    learn_paper(lessons=Lessons([drives], out, json_file=report), settings=Settings(5))
    model = PaperModel.load(out)
    assert (model.sequence_length, model.recovery) == (5, (False, False, False, True))
    assert model.successful == (True, True, True, False)
    said = json.loads(report.read_text())
    assert (said["recordings"], said["episodes"], said["frames"]) == (4, 4, 140)
    assert said["shared_states"] == said["states"] == 8
    assert said["remarks"] == []
    text = capsys.readouterr().out
    assert "shared states   8" in text
    assert "frames          140" in text


@pytest.mark.parametrize(
    ("purpose", "outcome", "reason"),
    [
        ("drive", "collision", "collision"),
        ("drive", "timeout", "victim not reached (out of time)"),
        (
            "run",
            "found",
            "the robot drove by itself (--include-runs takes successful runs)",
        ),
    ],
)
def test_learn_omits_episodes_when_they_must_not_teach(
    tmp_path: Path, purpose: Purpose, outcome: Outcome, reason: str
) -> None:
    path = record(tmp_path, drive("e", purpose=purpose, outcome=outcome))
    assert teach(path).teaching.uses == [DriveUse("e", 40, 0, reason)]
    with pytest.raises(JobError, match="episode e left out"):
        learn(lessons=Lessons([path], tmp_path / "model.smal"))


def test_successful_runs_teach_on_request(tmp_path: Path) -> None:
    for name, outcome in (("good", "found"), ("bad", "timeout")):
        record(tmp_path, drive(name, purpose="run", outcome=outcome))
    taught = teach(tmp_path, include_runs=True).teaching
    assert [one.name for one in taught.demonstrations] == ["good"]
    assert any("drove by itself without success (out of time)" in line for line in taught.lines())


def test_a_gap_splits_a_drive(tmp_path: Path) -> None:
    messages = [m for m in drive("e") if m.tick not in (10, 12)]
    teaching = teach(record(tmp_path, messages)).teaching
    assert [one.name for one in teaching.demonstrations] == ["e[0-9]", "e[13-39]"]
    assert [one.successful for one in teaching.demonstrations] == [False, True]
    assert [one.lost for one in teaching.demonstrations] == [0, 3]
    assert "e: 1 frames left out: without a movement" in teaching.remarks[0]


def test_an_episode_teaches_once(drives: Path, tmp_path: Path) -> None:
    copy = tmp_path / "copy.mcap"
    copy.write_bytes((drives / "drive-1.mcap").read_bytes())
    teaching = teach(drives, copy, drives / "drive-1.mcap").teaching
    assert len(teaching.demonstrations) == 4
    assert teaching.uses == [DriveUse("drive-1", 40, 0, f"already in {drives / 'drive-1.mcap'}")]


def test_damaged_recordings_are_named_and_the_rest_teaches(
    drives: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cut = drives / "drive-2.mcap"
    foreign = drives / "x.mcap"
    cut.write_bytes(cut.read_bytes()[: cut.stat().st_size // 2])
    foreign.write_bytes(b"not a recording")
    living = EpisodeWriter.begin(drives, event("living", 0, "started"))
    leave(drives, drive("left-behind", frames=20)[:-1])
    learn_paper(lessons=Lessons([drives], tmp_path / "model.smal"), settings=Settings())
    said = capsys.readouterr().err
    (whole,) = read_recording(cut).episodes
    assert f"smal: {cut}: truncated; {whole.frames} complete frames are read\n" in said
    assert f"smal: {foreign}: not an MCAP file\n" in said
    assert f"smal: {drives}/living.mcap.partial: still being recorded;" in said
    assert (
        f"smal: {drives}/left-behind.mcap.partial: truncated; 20 complete frames are read\n" in said
    )
    assert PaperModel.load(tmp_path / "model.smal").successful == (True, True, False, False, False)
    living.seal()


def test_one_drive_gives_a_map_and_states_of_the_paper(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = record(tmp_path, drive("drive-0"))
    report = tmp_path / "report.json"
    learn(lessons=Lessons([path], tmp_path / "mapped.smal", json_file=report))
    visual_map = Model.load(tmp_path / "mapped.smal").mapped
    assert visual_map.odometry
    # A straight drive does not tell its camera: a usual one is assumed.
    np.testing.assert_array_equal(visual_map.poses, [odometry(tick) for tick in range(40)])
    keyframes = len(visual_map.keyframes)
    assert json.loads(report.read_text())["keyframes"] == keyframes > 10
    text = capsys.readouterr().out
    assert f"keyframes       {keyframes}\n" in text
    assert "goals           victim\n" in text
    assert "states" not in text
    learn_paper(lessons=Lessons([path], tmp_path / "paper.smal"), settings=Settings())
    model = PaperModel.load(tmp_path / "paper.smal")
    text = capsys.readouterr().out
    assert f"states          {model.states}\n" in text
    assert "keyframes" not in text


def test_neither_images_nor_features_of_a_drive_fill_memory(tmp_path: Path) -> None:
    """The features of one frame take 33 kB."""
    held = []
    for frames in (20, 120):
        path = record(tmp_path, drive(f"drive-{frames}", frames=frames))
        tracemalloc.start()
        taught = teach(path, features=FeatureSettings()).teaching
        gc.collect()
        held.append(tracemalloc.get_traced_memory()[0])
        tracemalloc.stop()
        assert len(taught.demonstrations[0].rows) >= frames - 1
    assert held[1] - held[0] < 100 * 8_000


@pytest.mark.parametrize("kind", [CompressedImage, Odometry, Message])
def test_learn_joins_the_rest_when_a_frame_is_incomplete(
    tmp_path: Path, kind: type[Message]
) -> None:
    lost = [m for m in drive("e") if not (isinstance(m, kind) and m.tick == 20)]
    (joined,) = whole_drives(teach(record(tmp_path, lost)).teaching.demonstrations)
    assert joined.gaps == {19: 1}
    np.testing.assert_array_equal(
        joined.whole.odometry, [odometry(tick) for tick in range(40) if tick != 20]
    )


def test_a_recording_teaches_any_features_of_its_images(tmp_path: Path) -> None:
    wanted = FeatureSettings.of(("thumbnail", "gist"))
    (one,) = teach(record(tmp_path, drive("e")), features=wanted).teaching.demonstrations
    assert one.rows.shape == (40, wanted.size)


def test_the_camera_of_a_recording_is_that_of_the_map(tmp_path: Path) -> None:
    info = CameraInfo.after(
        header("e", 0), width=640, height=480, focal_px=450.0, centre_x_px=320.0, centre_y_px=240.0
    )
    begins, *follows = drive("e", frames=20)
    path = record(tmp_path, [begins, info, *follows])
    learn(lessons=Lessons([path], tmp_path / "model.smal"))
    assert Model.load(tmp_path / "model.smal").mapped.taught_scene.camera == Camera(450.0 / 640.0)


def test_drive_with_gaps_teaches_whole_when_it_has_no_odometry(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """As a tub of donkeycar, whose recording pauses while the car stands."""
    gaps = {*range(8, 14), 20, *range(36, 39)}
    kept = [m for m in drive("e") if m.tick not in gaps and not isinstance(m, Odometry)]
    failed = drive("failed", outcome="timeout")
    path = record(tmp_path, kept)
    record(tmp_path, failed)
    report = tmp_path / "report.json"
    learn(lessons=Lessons([tmp_path], tmp_path / "model.smal", json_file=report))
    assert Model.load(tmp_path / "model.smal").mapped.frames.tolist() == [30]
    captured = capsys.readouterr()
    assert "failed" not in captured.err
    assert captured.out.splitlines()[-4:-1] == [
        "drive   frames  used  note",
        "failed      40     0  victim not reached (out of time)",
        "e           30    30  3 gaps (1.0 s) bridged by views",
    ]
    assert captured.out.splitlines()[-1] == (
        f"next: smal run --world campus --model {tmp_path / 'model.smal'}"
    )
    assert json.loads(report.read_text())["uses"][1]["used"] == 30
    assert path.exists()

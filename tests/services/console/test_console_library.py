"""The list of recordings and models, whose names and files are untrusted; a belief on its map."""

import multiprocessing
import re
import signal
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.records import Chunk

from schemas.base import Message
from schemas.rpc import LoadReply, LoadRequest
from schemas.state import State
from services.console.learned import learned_of
from services.console.library import Library
from services.console.listing import ListedRecording, Reader, end_after
from services.console.report import report_page
from services.kit.model_service import identity_of
from services.kit.node import Node, ServiceError
from services.kit.settings import ServiceSettings
from services.recorder.service import RecorderService
from services.recordings.records import MAGIC
from tests import corridor
from tests.places import places
from tests.services.conftest import RunNode
from tests.services.console.conftest import Console, Nobody
from tests.services.console.page import Page
from tests.services.recordings import recorded_messages, test_recorder_files
from tests.services.recordings.recorded_messages import header
from tests.services.robot.wheels import Robot
from tests.services.waiting import eventually


def record(folder: Path, messages: list[Message], name: str | None = None) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    path = test_recorder_files.record(folder, messages)
    return path if name is None else path.rename(folder / name)


@pytest.fixture
def library(tmp_path: Path) -> Library:
    """Give a library of one drive."""
    record(tmp_path / "drives", list(recorded_messages.episode("drive-1", frames=12)))
    return Library(tmp_path)


def test_library_lists_outcome_length_and_pictures(
    library: Library,
) -> None:
    listed = library.look()
    (shown,) = listed["recordings"]
    assert shown["name"] == "drives/drive-1.mcap"
    facts = [shown[name] for name in ("outcome", "frames", "thumbnails", "useless")]
    assert facts == ["found", 12, 6, ""]
    assert shown["seconds"] == pytest.approx(1.1)
    (recording,) = library.recordings()
    assert all(picture.startswith(b"\xff\xd8") for picture in recording.thumbnails)


def test_report_of_a_drive_is_one_file(library: Library, nobody: Nobody, page: Page) -> None:
    library.look()
    nobody.library = library
    status, report = page.get("/report?of=drives/drive-1.mcap")
    assert status == 200
    for text in ("Drive to victim", "<dd>found</dd>", "<dd>1.1 s</dd>", "drive-1", "<polyline"):
        assert text in report.decode()
    (recording,) = library.recordings()
    assert f"<dd>{recording.metres:.1f} m</dd>" in report.decode()
    assert recording.metres > 0.0
    assert report.count(b"data:image/jpeg;base64,") == 6
    assert re.findall(rb'(?:src|href)="(?!data:)', report) == []
    assert page.get("/report?of=drives/other.mcap")[0] == 404


def test_kidnapped_run_is_listed_and_reported_as_such(tmp_path: Path) -> None:
    first, *rest = recorded_messages.episode("run-1", frames=12, purpose="run")
    moved = recorded_messages.event("run-1", 4, "kidnapped", purpose="run")
    record(tmp_path / "drives", [first, moved, *rest])
    library = Library(tmp_path)
    library.look()
    (recording,) = library.recordings()
    assert recording.useless == "the robot was kidnapped (frame 4), unknown to its odometry"
    report = report_page(recording)
    assert "<dt>kidnapped</dt><dd>once</dd>" in report
    assert report.count("<polyline") == 2  # the robot has not driven from piece to piece


def test_report_escapes_text_of_a_recording() -> None:
    listed = ListedRecording("drives/a.mcap", 1.0, 5, goal="<script>alert(1)</script>")
    assert "<script" not in report_page(listed)


def work_for_ever() -> None:
    end_after(1)
    while True:
        pass


def test_a_reader_ends_that_has_worked_for_too_long() -> None:
    process = multiprocessing.get_context("spawn").Process(target=work_for_ever)
    process.start()
    process.join()
    assert process.exitcode == -signal.SIGXCPU


def test_library_goes_on_when_a_file_kills_its_reader(library: Library) -> None:
    path = library.root / "drives" / "drive-1.mcap"
    listed = ListedRecording("drives/drive-1.mcap", 1.0, 5)
    with closing(Reader()) as reader:
        assert reader.read(path, listed).outcome == "found"
        reader.stop()
        died = "cannot be read: the reading process has died"
        assert reader.read(path, listed) == replace(listed, useless=died)
        assert reader.read(path, listed).outcome == "found"
    assert not [one for one in multiprocessing.active_children() if one.name == "recordings"]


def test_library_shows_known_files_while_it_reads(
    library: Library, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("services.console.library._SHOW_S", 0.0)
    chunk = Chunk("zstd", zstandard.compress(bytes(64 << 20)), 0, 0, 0, 64 << 20)
    builder = RecordBuilder()
    chunk.write(builder)
    (tmp_path / "drives" / "bomb.mcap").write_bytes(MAGIC + builder.end())
    shown: list[Any] = []
    library.look(shown.append)
    names = [[one["name"] for one in each["recordings"]] for each in shown]
    assert names == [["drives/bomb.mcap"], ["drives/bomb.mcap", "drives/drive-1.mcap"]], (
        "the newest first"
    )
    bomb, drive = shown[-1]["recordings"]
    assert bomb["useless"].startswith("unpacks to more than 256 times its size")
    assert drive["useless"] == ""


@pytest.mark.parametrize(
    ("outcome", "why"),
    [("collision", "collision"), ("aborted", "victim not reached (ended before the goal)")],
)
def test_library_names_why_a_recording_is_useless(tmp_path: Path, outcome: Any, why: str) -> None:
    record(tmp_path / "drives", list(recorded_messages.episode("drive-1", outcome=outcome)))
    (tmp_path / "drives" / "broken.mcap").write_bytes(b"nonsense")
    (tmp_path / "models").mkdir()
    (tmp_path / "models" / "broken.smal").write_bytes(b"nonsense")
    library = Library(tmp_path)
    library.look()
    assert {one.name: one.useless for one in library.recordings()}[
        "drives/broken.mcap"
    ] == "not an MCAP file"
    recording = library.recording("drives/drive-1.mcap")
    assert recording.useless == why
    assert f"<dd>{recording.shown()['result']}</dd>" in report_page(recording)
    assert [one.useless for one in library.models()] == ["not a SMAL model"]


def test_links_out_of_the_root_and_hidden_files_are_not_listed(tmp_path: Path) -> None:
    root = tmp_path / "root"
    outside = record(tmp_path / "outside", list(recorded_messages.episode("drive-1")))
    (root / "drives").mkdir(parents=True)
    (root / "drives" / "link.mcap").symlink_to(outside)
    (root / "drives" / ".hidden.mcap").write_bytes(outside.read_bytes())
    (root / "drives" / "line\nfeed.mcap").write_bytes(outside.read_bytes())
    library = Library(root.resolve())
    assert library.look()["recordings"] == []
    library.folder = None
    assert library.look() == {"folder": None, "recordings": [], "models": []}


def test_library_lists_goals_and_worlds_of_a_model(
    tmp_path: Path,
) -> None:
    corridor.save_model(tmp_path / "corridor.smal")
    library = Library(tmp_path)
    (shown,) = library.look()["models"]
    assert shown.pop("when_s") > 0.0
    assert shown == {"name": "corridor.smal", "goals": ("victim",), "useless": "", "worlds": []}
    (model,) = library.models()
    assert (model.longest, model.fingerprint) == (corridor.FRAMES, corridor.FEATURES.fingerprint)
    (episode,) = model.episodes
    record(
        tmp_path / "drives",
        [one.model_copy(update={"episode": episode}) for one in recorded_messages.episode("e")],
    )
    record(tmp_path / "drives", list(recorded_messages.episode("other")))
    (shown,) = library.look()["models"]
    assert shown["worlds"] == [library.recordings()[0].world]


def test_library_deletes_only_listed_recordings(
    console: Console, robot: Robot, open_page: Callable[[], Page]
) -> None:
    kept = record(console.root / "other", list(recorded_messages.episode("drive-1")))
    gone = record(console.root / "drives", list(recorded_messages.episode("drive-2")))
    page = open_page()
    eventually(lambda: page.state.get("library", {}).get("recordings"))
    page.take()
    eventually(lambda: page.beats)
    away = ("other/drive-1.mcap", "../drives/drive-2.mcap", "drives/../other/drive-1.mcap")
    for name in (*away, str(kept), ""):
        page.say(do="delete", file=name)
    page.say(do="rename", file="drives/drive-2.mcap", name="dock")
    eventually(lambda: page.state["library"]["recordings"][0]["name"] == "drives/dock.mcap")
    page.say(do="delete", file="drives/dock.mcap")
    eventually(lambda: not page.state["library"]["recordings"])
    assert page.news().count("file not found") == 5
    assert kept.exists()
    assert not gone.exists()


def test_library_renames_and_deletes_models(tmp_path: Path) -> None:
    for name in ("one", "two"):
        corridor.save_model(tmp_path / f"{name}.smal")
    library = Library(tmp_path)
    library.look()
    with pytest.raises(ServiceError, match="two already exists; choose another name"):
        library.rename("one.smal", "two")
    library.rename("one.smal", "three")
    library.delete("two.smal")
    assert [one.name for one in tmp_path.glob("*.smal")] == ["three.smal"]


def test_a_run_is_of_the_model_that_is_chosen_and_recorded(
    console: Console,
    robot: Robot,
    recorder: RecorderService,
    open_page: Callable[[], Page],
    settings: ServiceSettings,
    run_node: RunNode,
) -> None:
    loaded: list[tuple[str, LoadRequest]] = []
    corridor.save_model(console.root / "corridor.smal")
    features = Node("features", settings)
    features.detail = lambda: {"fingerprint": corridor.FEATURES.fingerprint}
    chain = {name: Node(name, settings) for name in ("recognition", "policy")}
    for name, node in chain.items():

        def load(request: LoadRequest, name: str = name) -> LoadReply:
            loaded.append((name, request))
            return LoadReply(scheme="filter", stride=1)

        node.serve("load", LoadRequest, load)
    for node in (features, *chain.values()):
        run_node(node)
    page = open_page()
    eventually(lambda: page.state.get("library", {}).get("models"))
    page.take()
    eventually(lambda: page.beats and page.robot(answers=True))
    run = {"model": "corridor.smal", "goal": "victim", "start": "start", "seed": 7}
    page.insist(lambda: str(page.state["robot"]["episode"]).startswith("run-7-"), do="run", **run)
    wanted = LoadRequest(model="corridor.smal", goal="victim")
    assert loaded[:2] == [("policy", wanted), ("recognition", wanted)]
    page.insist(lambda: page.state["library"]["recordings"], do="end", found=True)
    (recording,) = page.state["library"]["recordings"]
    facts = [recording[name] for name in ("purpose", "goal", "outcome")]
    assert facts == ["run", "victim", "found"]


def test_a_belief_is_not_drawn_when_its_places_are_unknown() -> None:
    learned = learned_of(corridor.model(), None, {})
    last = len(corridor.model().mapped.keyframes) - 1
    for keyframes, drawn in (((last,), True), ((last + 1,), False), ((last, 1_000_000), False)):
        where = places(*[(key, 0.0, 0.0, 0.0, 0.5) for key in keyframes])
        state = State.after(
            header("e", 0), status="recognized", model=identity_of(corridor.model()), places=where
        )
        assert bool(learned.belief(state)) is drawn

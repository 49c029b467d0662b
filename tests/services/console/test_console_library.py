"""What was recorded and learned, as the page lists it; names and files may be anybody's."""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.records import Chunk

from schemas.base import Message
from schemas.command import CommandApplied
from schemas.episode import Episode
from schemas.rpc import LoadReply, LoadRequest
from schemas.state import Place, State
from services.console.learned import learned_of
from services.console.library import LearnedModel, Library
from services.console.listing import Reader, Recording, end_after
from services.kit.model_service import identity_of
from services.kit.node import Node
from services.kit.settings import ServiceSettings
from services.recorder.service import RecorderService
from services.recordings.reader import read_recording
from services.recordings.records import MAGIC
from services.recordings.writer import EpisodeWriter
from smal.mapping import fit
from tests import corridor
from tests.services.conftest import RunNode
from tests.services.console.conftest import Console
from tests.services.console.page import Page
from tests.services.recordings import recorded_messages
from tests.services.robot.wheels import Robot
from tests.services.waiting import eventually


def record(folder: Path, messages: list[Message], name: str | None = None) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    writer = EpisodeWriter.begin(folder, messages[0])
    for message in messages:
        writer.write(message)
    path = writer.seal()
    return path if name is None else path.rename(folder / name)


@pytest.fixture
def library(tmp_path: Path) -> Library:
    """Give a library of one drive."""
    record(tmp_path / "drives", list(recorded_messages.episode("drive-1", frames=12)))
    return Library(tmp_path)


def test_a_recording_has_its_outcome_its_length_and_pictures_along_the_drive(library: Library) -> None:
    listed = library.look()
    (shown,) = listed["recordings"]  # type: ignore[misc]
    assert shown["name"] == "drives/drive-1.mcap"
    assert (shown["outcome"], shown["frames"], shown["thumbnails"], shown["useless"]) == ("found", 12, 6, "")
    assert shown["seconds"] == pytest.approx(1.1)
    (recording,) = library.recordings()
    assert all(picture.startswith(b"\xff\xd8") for picture in recording.thumbnails)


def test_a_file_is_read_once_and_again_when_it_has_changed(library: Library, tmp_path: Path) -> None:
    library.look()
    (before,) = library.recordings()
    library.look()
    assert library.recordings()[0] is before
    path = tmp_path / "drives" / "drive-1.mcap"
    os.utime(path, ns=(1, 1))
    library.look()
    assert library.recordings()[0] is not before
    path.unlink()
    library.look()
    assert library.recordings() == []


def work_for_ever() -> None:
    end_after(1)
    while True:
        pass


def test_a_reader_ends_that_has_worked_for_too_long() -> None:
    process = multiprocessing.get_context("spawn").Process(target=work_for_ever)
    process.start()
    process.join()
    assert process.exitcode == -signal.SIGXCPU


def test_a_file_that_ends_its_reader_is_unreadable_and_the_next_is_read(library: Library) -> None:
    path, listed = library.root / "drives" / "drive-1.mcap", Recording("drives/drive-1.mcap", 1.0, 5)
    with closing(Reader()) as reader:
        assert reader.read(path, listed).outcome == "found"
        reader.stop()
        died = "it cannot be read: the process that read it has died"
        assert reader.read(path, listed) == replace(listed, useless=died)
        assert reader.read(path, listed).outcome == "found"
    assert not [one for one in multiprocessing.active_children() if one.name == "recordings"]


def test_what_is_known_is_shown_while_more_is_read(
    library: Library, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A file that unpacks to far more than its size is listed as unreadable, and keeps nobody."""
    monkeypatch.setattr("services.console.library._SHOW_S", 0.0)
    chunk = Chunk("zstd", zstandard.compress(bytes(64 << 20)), 0, 0, 0, 64 << 20)
    builder = RecordBuilder()
    chunk.write(builder)
    (tmp_path / "drives" / "bomb.mcap").write_bytes(MAGIC + builder.end())
    shown: list[Any] = []
    library.look(shown.append)
    names = [[one["name"] for one in each["recordings"]] for each in shown]
    assert names == [["drives/bomb.mcap"], ["drives/bomb.mcap", "drives/drive-1.mcap"]], "the newest first"
    bomb, drive = shown[-1]["recordings"]
    assert bomb["useless"].startswith("unpacks to more than 256 times its size")
    assert drive["useless"] == ""


@pytest.mark.parametrize(("outcome", "why"), [("collision", "collision"), ("aborted", "did not reach the victim")])
def test_what_teaches_nothing_says_why(tmp_path: Path, outcome: Any, why: str) -> None:
    record(tmp_path / "drives", list(recorded_messages.episode("drive-1", outcome=outcome)))
    (tmp_path / "drives" / "broken.mcap").write_bytes(b"nonsense")
    (tmp_path / "models").mkdir()
    (tmp_path / "models" / "broken.smal").write_bytes(b"nonsense")
    library = Library(tmp_path)
    library.look()
    assert {one.name: one.useless for one in library.recordings()}["drives/broken.mcap"] == "not an MCAP file"
    assert why in {one.name: one.useless for one in library.recordings()}["drives/drive-1.mcap"]
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
    library.record_in(tmp_path / "outside")
    assert library.look() == {"folder": None, "recordings": [], "models": []}


def test_of_a_link_it_is_the_link_that_is_deleted(library: Library, tmp_path: Path) -> None:
    kept = tmp_path / "drives" / "drive-1.mcap"
    (tmp_path / "drives" / "link.mcap").symlink_to(kept)
    library.look()
    library.delete("drives/link.mcap")
    assert kept.exists()
    assert not (tmp_path / "drives" / "link.mcap").is_symlink()


def test_a_model_tells_its_goals_and_the_worlds_of_the_recordings_that_are_there(tmp_path: Path) -> None:
    corridor.save_model(tmp_path / "corridor.smal")
    library = Library(tmp_path)
    (shown,) = library.look()["models"]  # type: ignore[misc]
    assert shown == {"name": "corridor.smal", "goals": ("victim",), "useless": "", "worlds": []}
    (model,) = library.models()
    assert (model.longest, model.fingerprint) == (corridor.FRAMES, corridor.FEATURES.fingerprint)
    (episode,) = model.episodes
    record(tmp_path / "drives", [one.model_copy(update={"episode": episode}) for one in recorded_messages.episode("e")])
    record(tmp_path / "drives", list(recorded_messages.episode("other")))
    (shown,) = library.look()["models"]  # type: ignore[misc]
    assert shown["worlds"] == [library.recordings()[0].world]


@pytest.mark.parametrize(("source", "corrected"), [("teleop", True), ("policy", False)])
def test_a_run_is_corrected_where_a_person_took_over(tmp_path: Path, source: Any, corrected: bool) -> None:
    messages = [
        one.model_copy(update={"source": source}) if isinstance(one, CommandApplied) and one.tick == 2 else one
        for one in recorded_messages.episode("run-1", purpose="run")
    ]
    record(tmp_path / "drives", messages)
    library = Library(tmp_path)
    (shown,) = library.look()["recordings"]  # type: ignore[misc]
    assert shown["corrected"] is corrected


def test_a_model_of_the_papers_scheme_has_no_goal_to_choose_and_is_not_drawn(
    console: Console, robot: Robot, open_page: Callable[[], Page], settings: ServiceSettings, run_node: RunNode
) -> None:
    corridor.paper_model().save(console.root / "paper.smal")
    recognition = Node("recognition", settings)
    recognition.detail = lambda: {"model": "paper.smal", "checksum": identity_of(corridor.paper_model()), "goal": None}
    run_node(recognition)
    page = open_page()
    (model,) = eventually(lambda: page.state.get("library", {}).get("models"))
    assert (model["goals"], model["useless"]) == ([], "")
    shown = eventually(lambda: page.state.get("model", {}).get("trouble"))
    assert shown == "paper.smal is for the paper's scheme: its states have no places on a map."


def test_where_a_belief_is_on_the_taught_way() -> None:
    model = corridor.model()
    learned = learned_of(model, None, {})
    assert learned.goal == "victim"
    assert np.all(np.diff(learned.cost_s) < 0)
    header = recorded_messages.header("run-1", 3)
    last = len(learned.drives) - 1
    places = tuple(
        Place(keyframe=keyframe, ahead_m=0.1, left_m=0.2, turned_rad=0.0, weight=weight)
        for keyframe, weight in ((last, 0.6), (0, 0.4))
    )
    state = State.after(header, status="recognized", model=identity_of(model), places=places, lost=0.5)
    shown = learned.belief(state)
    assert (shown["keyframe"], shown["cost"], shown["sure"]) == (last, 0.0, 0.3)
    assert shown["pose"] == pytest.approx([corridor.STEP_M * (corridor.FRAMES - 1) + 0.1, 0.2, 0.0])
    assert learned.belief(state.model_copy(update={"model": "0" * 16})) == {}
    assert learned.image(0) is None
    assert learned.image(10**6) is None


def test_the_taught_image_is_that_of_the_recording(tmp_path: Path) -> None:
    """Also where the first frames of the drive were not recorded."""
    way = [corridor.pose(frame) for frame in range(corridor.FRAMES)]
    images = [corridor.view(*one) for one in way]
    atoms = [corridor.Atom.FORWARD] * (corridor.FRAMES - 1) + [corridor.Atom.STOP]
    model = fit([(images, atoms, np.array(way))], corridor.FEATURES)
    ((name,),) = model.mapped.names
    messages = [
        message.model_copy(update={"episode": name, "tick": message.tick + 3 * (message.tick > 0)})
        for message in recorded_messages.episode("drive-1", frames=corridor.FRAMES)
    ]
    path = record(tmp_path, messages)
    learned = learned_of(model, "victim", {name: path})
    first, last = learned.image(0), learned.image(len(learned.drives) - 1)
    assert last is not None
    assert last == recorded_messages.image("x", corridor.FRAMES - 1).data
    assert first != last
    episodes = read_recording(path).episodes
    assert learned.shown()["world"] == learned.world == episodes[0].world != ""
    assert learned_of(model, "victim", {}).world == "", "nobody knows"


def test_only_what_is_listed_is_deleted(console: Console, robot: Robot, open_page: Callable[[], Page]) -> None:
    kept = record(console.root / "other", list(recorded_messages.episode("drive-1")))
    gone = record(console.root / "drives", list(recorded_messages.episode("drive-2")))
    page = open_page()
    eventually(lambda: page.state.get("library", {}).get("recordings"))
    page.take()
    eventually(lambda: page.beats)
    for name in ("other/drive-1.mcap", "../drives/drive-2.mcap", "drives/../other/drive-1.mcap", str(kept), ""):
        page.say(do="delete", recording=name)
    page.say(do="delete", recording="drives/drive-2.mcap")
    eventually(lambda: not page.state["library"]["recordings"])
    assert page.news().count("no such recording") == 5
    assert kept.exists()
    assert not gone.exists()


def test_what_cannot_be_run_or_learned_is_said(console: Console, robot: Robot, open_page: Callable[[], Page]) -> None:
    corridor.save_model(console.root / "corridor.smal")
    page = open_page()
    eventually(lambda: page.state.get("library", {}).get("models"))
    page.take()
    eventually(lambda: page.beats and page.robot(answers=True))
    run = {"do": "run", "start": "start", "seed": 1}
    page.say(**run, model="none.smal", goal="victim")
    eventually(lambda: "none.smal: no such model" in page.news())
    page.say(**run, model="corridor.smal", goal="dock")
    eventually(lambda: "has no goal dock; it has victim" in page.news())
    page.say(**run, model="corridor.smal", goal="victim")
    eventually(lambda: "features status: no answer" in page.news())
    page.say(do="learn", name="way", recordings=["drives/none.mcap"])
    eventually(lambda: "gone, or teaches nothing" in page.news())


@pytest.mark.parametrize("scheme", ["filter", "paper"])
def test_a_run_is_of_the_model_that_is_chosen_and_recorded(
    console: Console,
    robot: Robot,
    recorder: RecorderService,
    open_page: Callable[[], Page],
    settings: ServiceSettings,
    run_node: RunNode,
    scheme: str,
) -> None:
    """Recorded as well, since a person may correct it by hand."""
    loaded: list[tuple[str, LoadRequest]] = []
    model = corridor.model() if scheme == "filter" else corridor.paper_model()
    model.save(console.root / "corridor.smal")
    features = Node("features", settings)
    features.detail = lambda: {"fingerprint": corridor.FEATURES.fingerprint}
    chain = {name: Node(name, settings) for name in ("recognition", "policy")}
    for name, node in chain.items():

        def load(request: LoadRequest, name: str = name) -> LoadReply:
            loaded.append((name, request))
            return LoadReply(scheme=model.scheme, stride=1)

        node.serve("load", LoadRequest, load)
    for node in (features, *chain.values()):
        run_node(node)
    page = open_page()
    eventually(lambda: page.state.get("library", {}).get("models"))
    page.take()
    eventually(lambda: page.beats and page.robot(answers=True))
    # The page has no goals to choose from for the paper's scheme.
    goal = "victim" if scheme == "filter" else None
    run = {"model": "corridor.smal", "goal": goal, "start": "start", "seed": 7}
    page.insist(lambda: str(page.state["robot"]["episode"]).startswith("run-7-"), do="run", **run)
    wanted = LoadRequest(model="corridor.smal", goal=goal)
    assert loaded[:2] == [("recognition", wanted), ("policy", wanted)]
    page.say(do="end", found=True)
    (recording,) = eventually(lambda: page.state["library"]["recordings"])
    assert (recording["purpose"], recording["goal"], recording["outcome"]) == ("run", "victim", "found")


@pytest.mark.parametrize(("goals", "nearest"), [((), "victim"), (("dock",), "dock"), (("dock", "ward"), "nearest")])
def test_a_run_to_the_nearest_of_several_goals_is_not_said_to_lead_to_one_of_them(
    tmp_path: Path, goals: tuple[str, ...], nearest: str
) -> None:
    """Whoever learned from it would teach a goal where another one is; a model of the paper's scheme names none."""
    for goal in goals:
        messages = recorded_messages.episode(f"to-{goal}")
        told = [one.model_copy(update={"goal": goal}) if isinstance(one, Episode) else one for one in messages]
        record(tmp_path / "drives", told)
    library = Library(tmp_path)
    library.look()
    assert library.leads_to(LearnedModel("a", 0.0, 1, episodes=frozenset(f"to-{goal}" for goal in goals))) == nearest
    assert library.leads_to(LearnedModel("a", 0.0, 1, goals=goals)) == nearest

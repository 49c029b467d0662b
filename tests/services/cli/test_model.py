"""``smal model show``: what was learned is on the page, what is missing is named, and nothing of a model is markup."""

import re
from collections.abc import Iterator
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest

from schemas.base import Message
from schemas.motion import TruePose
from services.experiments.showing.drives import find_drives
from services.experiments.showing.page import write_page
from services.recordings.dataset import Teacher, find_recordings
from smal.keyframes import MapConfig
from smal.model import Model
from smal.movement import Atom
from smal.paper.learning import LearningSettings, learn
from smal.paper.model import PaperModel
from smal.teaching.mapping import learn as learn_map
from tests.services.cli.conftest import Mistake, Smal
from tests.services.recordings.recorded_messages import applied, event, header, seen
from tests.services.recordings.test_recorder_files import record
from tests.sharing import made_once
from tests.smal.synthetic_world import COLOR, SCENE, START, Drive, Room, drive

#: Two drives that begin the same way and part after 2 m.
DRIVES = {
    "left": drive(START, ((2.0, 60.0), (1.5, 0.0))),
    "right": drive(START, ((2.0, -60.0), (1.5, 0.0))),
}


def messages(name: str, one: Drive, room: Room, goal: str) -> Iterator[Message]:
    """Give a drive through a room that reached a goal, as the recorder would get it."""
    yield event(name, 0, "started").model_copy(update={"goal": goal})
    for tick, (pose, atom) in enumerate(zip(one.poses, one.atoms, strict=True)):
        yield from seen(header(name, tick), room.look(pose), pose.tolist(), speed_m_s=0.5)
        x_m, y_m, heading_rad = pose.tolist()
        yield TruePose.after(header(name, tick), x_m=x_m, y_m=y_m, heading_rad=heading_rad)
        yield applied(name, tick, atom=Atom(atom).name.lower())
    yield event(name, len(one.poses) - 1, "ended", "found").model_copy(update={"goal": goal})


def make(folder: Path) -> None:
    """Record both drives, and learn them for both schemes."""
    recordings = folder / "drives"
    recordings.mkdir()
    for goal, one in DRIVES.items():
        record(recordings, list(messages(f"to-{goal}", one, Room(), goal)))
    teacher = Teacher(COLOR, 5)
    for path in find_recordings([recordings]):
        teacher.read(path)
    told = {"fit_camera": lambda *_: SCENE.camera, "fit_scene": lambda *_: SCENE}
    with patch.multiple("smal.teaching.mapping", **told):
        learn_map(teacher.teaching.demonstrations, COLOR, config=MapConfig(sampled_views=250)).save(
            folder / "two.smal"
        )
    learn(teacher.teaching.demonstrations, LearningSettings(COLOR)).save(folder / "paper.smal")


@pytest.fixture(scope="module")
def taught(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return made_once(tmp_path_factory, "model-show", make)


@pytest.fixture(scope="module")
def model(taught: Path) -> Model:
    return Model.load(taught / "two.smal")


@pytest.fixture(scope="module")
def paper_model(taught: Path) -> PaperModel:
    return PaperModel.load(taught / "paper.smal")


class Page(HTMLParser):
    """What a browser would make of a page."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: set[str] = set()
        self.attributes: list[tuple[str, str]] = []
        self.texts: list[str] = []
        self.rows: list[list[str]] = []
        self._cell = False
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.add(tag)
        self.attributes += [(name, value or "") for name, value in attrs]
        self._cell = tag in ("td", "th")
        if tag == "tr":
            self.rows.append([])

    def handle_endtag(self, tag: str) -> None:
        self._cell = False

    def handle_data(self, data: str) -> None:
        self.texts.append(data)
        if self._cell:
            self.rows[-1].append(data)


def shown(smal: Smal, out: Path, *arguments: object) -> tuple[Page, str]:
    status, _, err = smal("model", "show", *arguments, "--out", out)
    assert status == 0, err
    return Page((out / "index.html").read_text()), err


def photos(page: Page) -> int:
    """Return how many camera images are on a page."""
    return sum(
        name == "src" and value.startswith("data:image/jpeg") for name, value in page.attributes
    )


def test_map_page_draws_svg_in_the_colours_of_the_page(
    taught: Path, tmp_path: Path, smal: Smal
) -> None:
    model = tmp_path / "campus.smal"
    replace(Model.load(taught / "two.smal"), world="campus").save(model)
    shown(smal, tmp_path, model, "--recordings", taught / "drives")
    text = (tmp_path / "index.html").read_text()
    assert text.count("<svg") >= 4
    assert "data:image/png" not in text
    assert not re.search("#222222|#0b5fa5", text.split("</style>", 1)[1])
    assert "var(--text)" in text
    assert "in the world&#39;s axes" in text
    assert "east (m)" in text


def test_map_page_shows_fork_drives_and_belief(taught: Path, tmp_path: Path, smal: Smal) -> None:
    page, err = shown(smal, tmp_path, taught / "two.smal", "--recordings", taught / "drives")
    assert "missing" not in err
    text = " ".join(page.texts)
    assert re.search(r"1: fork \d\.\d m along to-left, with to-right", text)
    assert photos(page) == 2 * 5
    assert "to-left, frame 0" in text
    assert [
        row[2] for row in page.rows if row[1:2] in (["to left"], ["to right"]) and len(row) == 4
    ] == ["there"] * 2
    belief = [row for row in page.rows if len(row) == 5 and row[0].startswith("to-")]
    assert [row[0] for row in belief] == ["to-left", "to-right"]
    assert all(float(row[1].rstrip("%")) > 80 for row in belief)


@pytest.mark.parametrize("scheme", ["filter", "paper"])
@pytest.mark.parametrize("recordings", [True, False])
def test_map_page_escapes_text_and_loads_no_network_files(
    model: Model,
    paper_model: PaperModel,
    taught: Path,
    tmp_path: Path,
    recordings: bool,
    scheme: str,
) -> None:
    hostile = "<img src=x onerror=alert(1)>\"'&漢"
    mapped = replace(model.mapped)
    # A model in a file cannot have such goals; the page escapes them all the same.
    object.__setattr__(mapped, "goals", (f"{hostile}a", f"{hostile}b"))
    names = f"{hostile}\x1b]0;", f"</title><script>alert(1)</script>{hostile}"
    object.__setattr__(mapped, "names", ((names[0],), (names[1],)))
    bad = replace(model, mapped=mapped) if scheme == "filter" else replace(paper_model, names=names)
    file = tmp_path / "<script>alert(1)<.smal"
    model.save(file)
    found = find_drives(bad, find_recordings([taught / "drives"])) if recordings else None
    text = write_page(tmp_path, bad, file, found).read_text()
    page = Page(text)
    assert "script" not in page.tags
    assert "iframe" not in page.tags
    assert not [name for name, _ in page.attributes if name.startswith("on")]
    linked = [value for name, value in page.attributes if name in ("src", "href", "xlink:href")]
    assert all(value.startswith(("#", "data:image/")) for value in linked)
    assert any("<img src=x onerror" in one for one in page.texts)
    assert "\x1b" not in text


@pytest.mark.parametrize("file", ["two.smal", "paper.smal"])
def test_missing_recordings_are_named(taught: Path, tmp_path: Path, smal: Smal, file: str) -> None:
    folder = tmp_path / "drives"
    folder.mkdir()
    # Another drive has the name of the first; the second is missing.
    shorter = Drive(DRIVES["left"].poses[:-4], DRIVES["left"].atoms[:-4])
    record(folder, list(messages("to-left", shorter, Room(), "left")))
    record(folder, list(messages("another", DRIVES["right"], Room(), "right")))
    page, err = shown(smal, tmp_path / "out", taught / file, "--recordings", folder)
    told = [
        "to-left: the recording of this name is of another drive",
        "to-right: recording not found",
    ]
    assert [line for line in err.splitlines() if "missing: " in line] == [
        f"smal: missing: {line}" for line in told
    ]
    assert all(line in page.texts for line in told)
    assert photos(page) == 0
    assert ("Recognition was not run" in " ".join(page.texts)) == (file == "two.smal")


@pytest.mark.parametrize(
    ("change", "said"),
    [({"reward": np.nan}, "finite"), ({"state_streams": 10**6}, "state_streams")],
)
def test_an_odd_model_is_one_line(
    paper_model: PaperModel, tmp_path: Path, mistake: Mistake, change: dict[str, object], said: str
) -> None:
    ((name, value),) = change.items()
    odd = replace(paper_model)
    part = getattr(paper_model, name)
    value = (
        tuple(np.full_like(one, value) for one in part)
        if isinstance(part, tuple)
        else np.full_like(part, value)
    )
    object.__setattr__(odd, name, value)
    odd.save(tmp_path / "odd.smal")
    err = mistake(1, "model", "show", tmp_path / "odd.smal", "--out", tmp_path / "out")
    assert err == f"smal: {tmp_path}/odd.smal: the parts of the model do not fit together: {said}\n"

"""``smal match``: two folders of images in; matches as JSON, text and picture out."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from types import MappingProxyType

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from services.cli import match
from smal.features import Centering, FeatureSettings
from smal.place_recognition import Matches
from smal.place_recognition.matches import Progress
from smal.place_recognition.methods import METHODS, MatchSettings, Method
from smal.place_recognition.nearest_sequence import match_nearest_sequence
from tests.services.cli.conftest import Mistake, Smal

FRAMES = 24
LENGTH = 4
#: A wall that a camera passes; what is seen at a place is where it is.
WALL = cv2.resize(np.random.default_rng(3).integers(0, 256, (6, 90, 3), dtype=np.uint8), (1080, 72))
NAMES = [f"img{number}.png" for number in range(FRAMES)]


def view(place: int) -> np.ndarray:
    return np.ascontiguousarray(WALL[:, 36 * place : 36 * place + 96])


def nearest(
    references: NDArray[np.float32], queries: NDArray[np.float32], settings: MatchSettings, progress: Progress
) -> Matches:
    centering = Centering.fit(references, settings.features)
    return match_nearest_sequence(centering.apply(references), centering.apply(queries), settings.length, progress)


def table_of(**methods: Method) -> MappingProxyType[str, Method]:
    return MappingProxyType(methods)


COLOUR = FeatureSettings.of(["color"])
TABLE = table_of(
    smal=Method("for these tests.", COLOUR, nearest, LENGTH),
    own=Method("with its own features.", COLOUR, nearest, any_features=False, any_length=False),
)


@pytest.fixture
def folders(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Make two traverses of the wall, the second darker; the place of frame i is i in both. Work beside them."""
    monkeypatch.setattr(match, "METHODS", TABLE)
    monkeypatch.chdir(tmp_path)
    for name, share in (("ref", 1.0), ("query", 0.7)):
        Path(name).mkdir()
        for place, file in enumerate(NAMES):
            cv2.imwrite(f"{name}/{file}", (share * view(place)).astype(np.uint8))
    write_truth([(place, max(0, place - 1), place) for place in range(FRAMES)])
    yield tmp_path
    left = [path.name for path in tmp_path.iterdir() if path.name.startswith(".")]
    assert left == []  # no half-written file


def write_truth(rows: list[tuple[int, int | str, int | str]]) -> None:
    lines = [f"{query},{first},{last}" for query, first, last in rows]
    Path("truth.csv").write_text("\n".join(["query,reference_first,reference_last", *lines]) + "\n")


def matched(smal: Smal, *arguments: str) -> dict[str, object]:
    status, _, _ = smal("match", "ref", "query", "--json", "out.json", *arguments)
    assert status == 0
    return json.loads(Path("out.json").read_text())


def references_of(written: dict[str, object]) -> list[int | None]:
    rows = written["matches"]
    assert isinstance(rows, list)
    assert [row["query"] for row in rows] == list(range(len(rows)))
    assert all(set(row) == {"query", "reference", "score", "unknown"} for row in rows)
    return [row["reference"] for row in rows]


def test_frames_that_cannot_be_read_keep_their_numbers(folders: Path, smal: Smal) -> None:
    Path("ref/img7.png").write_bytes(b"damaged")
    whole = Path("query/img15.png").read_bytes()
    Path("query/img15.png").write_bytes(whole[:-40])
    Path("query/truth.txt").touch()
    status, out, err = smal("match", "ref", "query", "--json", "out.json", "--length", "1", "--truth", "truth.csv")
    assert status == 0
    assert err.splitlines() == [
        "smal: ref: skipped 1, unreadable, and kept in the count of frames: img7.png",
        "smal: query: skipped 1, no images: truth.txt",
        "smal: query: skipped 1, unreadable, and kept in the count of frames: img15.png",
    ]
    written = json.loads(Path("out.json").read_text())
    found = references_of(written)
    assert found[15] is None
    assert found[7] not in {None, 7}  # the frame of this place cannot be seen
    assert [found[place] for place in range(FRAMES) if place not in {7, 15}] == [
        place for place in range(FRAMES) if place not in {7, 15}
    ]
    assert (written["unreadable_references"], written["unreadable_queries"]) == (["img7.png"], ["img15.png"])
    assert "23 of 24 query frames" in out
    assert "24 frames (1 of them unreadable) in ref" in out


def test_depth_is_read_from_its_own_folders(folders: Path, smal: Smal) -> None:
    for name in ("ref", "query"):
        Path(f"{name}-depth").mkdir()
        for place, file in enumerate(NAMES):
            cv2.imwrite(f"{name}-depth/{file}", 200 * view(place)[..., 0].astype(np.uint16))
            cv2.imwrite(f"{name}/{file}", np.full((48, 64, 3), 99, np.uint8))  # nothing to see but depth
    arguments = ("--modalities", "depth", "--reference-depth", "ref-depth", "--query-depth", "query-depth")
    assert references_of(matched(smal, *arguments, "--length", "1")) == list(range(FRAMES))


@pytest.mark.parametrize(
    ("arguments", "status", "line"),
    [
        (["none", "query"], 2, "REFERENCE_DIR none: No such file or directory"),
        (["ref", "damaged"], 1, "damaged: no image can be read: a.png"),
        (["ref", "query", "--length", "25"], 1, "ref: 24 images, too few for a window of 25; choose a shorter"),
        (["ref", "query", "--json", "query/img3.png"], 2, "--json query/img3.png: would lie among the files"),
        (["ref", "query", "--method", "x"], 2, "--method x: unknown; known are smal, own"),
        (["ref", "query", "--online", "0"], 2, "--online 0: the scores of the method smal are no probabilities"),
        (["ref", "query", "--precision", "0.9"], 2, "--precision 0.9: the scores of the method smal are no"),
        (["ref", "query", "--method", "own", "--length", "2"], 2, "--length 2: the method own has no windows"),
        (["ref", "query", "--modalities", "x"], 2, "unknown feature modality 'x'; known are "),
        (["ref", "query", "--truth", "short.csv"], 2, "--truth short.csv: line 2: query 24 is beyond the traverse"),
        (["ref", "query", "--truth", "truth.csv", "--json", "truth.csv"], 2, "--json truth.csv: is a file that this"),
        (["ref", "query", "--plot", "x.bmp"], 2, "--plot x.bmp: the name of a picture ends in .png, .svg, .pdf"),
        (["ref", "query", "--modalities", "depth"], 2, "--reference-depth: belongs to the modality depth"),
        (["ref", "query", "--modalities", "depth", "--reference-depth", "ref", "--query-depth", "damaged"], 2,
         "--query-depth damaged: has 1 images, and query has 24"),
    ],
)  # fmt: skip
def test_mistakes_are_one_line(arguments: list[str], status: int, line: str, folders: Path, mistake: Mistake) -> None:
    (folders / "damaged").mkdir()
    (folders / "damaged" / "a.png").touch()
    (folders / "short.csv").write_text("query,reference_first,reference_last\n24,0,0\n")
    assert line in mistake(status, "match", *arguments)
    assert not (folders / "x.png").exists()


@pytest.mark.parametrize(
    ("raised", "status", "line"),
    [
        (KeyboardInterrupt(), 130, "interrupted"),
        (ValueError("these cannot be"), 1, "cannot match these folders: these cannot be"),
        (MemoryError(), 1, "matching 24 and 24 frames takes more memory than there is"),
    ],
)
def test_what_ends_before_the_end_leaves_the_file_as_it_was(
    raised: BaseException, status: int, line: str, folders: Path, mistake: Mistake, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> Matches:
        raise raised

    monkeypatch.setattr(match, "METHODS", table_of(smal=Method("fails.", COLOUR, fail, LENGTH)))
    Path("out.json").write_text("as it was")
    said = mistake(status, "match", "ref", "query", "--json", "out.json", "--plot", "out.png")
    assert said == f"smal: {line}\n"
    assert Path("out.json").read_text() == "as it was"
    assert not Path("out.png").exists()


@pytest.mark.parametrize("name", sorted(METHODS))
def test_every_method_of_the_table_finds_its_way(
    name: str, folders: Path, smal: Smal, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(match, "METHODS", METHODS)
    written = matched(smal, "--method", name, "--truth", str(folders / "truth.csv"))
    assert written["length"] == (METHODS[name].length if METHODS[name].any_length else None)
    found = references_of(written)
    assert len(found) == FRAMES
    given = [(place, reference) for place, reference in enumerate(found) if reference is not None]
    assert given
    assert all(abs(place - reference) <= 2 for place, reference in given)


def test_probable_matches_are_calibrated_and_drawn(folders: Path, smal: Smal, monkeypatch: pytest.MonkeyPatch) -> None:
    """The references lack the first third."""
    monkeypatch.setattr(match, "METHODS", METHODS)
    for name in NAMES[:8]:
        Path(f"ref/{name}").unlink()
    unknown: list[tuple[int, int | str, int | str]] = [(place, "", "") for place in range(8)]
    write_truth([*unknown, *[(place, place - 8, place - 8) for place in range(8, FRAMES)]])
    for online in ([], ["--online", "2"]):
        written = matched(
            smal, "--tolerance", "1", "--precision", "0.9", "--truth", "truth.csv", "--plot", "out.svg", *online
        )
        assert {"calibration_error", "known_from_unknown", "auc_95"} <= set(written)
        assert references_of(written)[20] in {None, 11, 12, 13}
        assert written["precision"] == 0.9
    assert Path("out.svg").stat().st_size > 1000


def test_without_a_file_some_matches_are_printed(folders: Path, smal: Smal) -> None:
    status, out, _ = smal("match", "ref", "query", "--tau", "0.999")
    assert status == 0
    assert "12 of 24 query frames; --json FILE writes every match" in out
    assert out.count("img") >= 12

"""``smal match``: two folders of images in; matches as JSON, text and picture out."""

from __future__ import annotations

import errno
import json
import os
from collections.abc import Iterator
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from schemas.camera import CompressedImage
from services.cli import match
from services.experiments.matching import feature_cache, traverse
from services.kit.jpeg import encode_jpeg
from services.recordings.writer import EpisodeWriter
from smal.features import Centering, FeatureSettings
from smal.features import extract as smal_extract
from smal.place_recognition import Matches
from smal.place_recognition.matches import Progress
from smal.place_recognition.methods import METHODS, MatchSettings, Method
from smal.place_recognition.nearest_sequence import match_nearest_sequence
from tests.services.cli.conftest import Mistake, Smal
from tests.services.recordings.recorded_messages import event, header

if TYPE_CHECKING:
    from playwright.sync_api import Browser

FRAMES = 24
LENGTH = 4
#: A wall that a camera passes; what is seen at a place is where it is.
WALL = cv2.resize(np.random.default_rng(3).integers(0, 256, (6, 90, 3), dtype=np.uint8), (1080, 72))
NAMES = [f"img{number}.png" for number in range(FRAMES)]


def view(place: int) -> np.ndarray:
    return np.ascontiguousarray(WALL[:, 36 * place : 36 * place + 96])


def nearest(
    references: NDArray[np.float32],
    queries: NDArray[np.float32],
    settings: MatchSettings,
    progress: Progress,
) -> Matches:
    centering = Centering.fit(references, settings.features)
    return match_nearest_sequence(
        centering.apply(references), centering.apply(queries), settings.length, progress
    )


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
    monkeypatch.setattr(feature_cache, "cache_file", lambda: tmp_path / "cache" / "features.sqlite")
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


def matched(smal: Smal, arguments: str) -> dict[str, object]:
    status, _, _ = smal("match", "ref", "query", "--json", "out.json", *arguments.split())
    assert status == 0
    return json.loads(Path("out.json").read_text())


def references_of(written: dict[str, object]) -> list[int | None]:
    rows = written["matches"]
    assert [row["query"] for row in rows] == list(range(len(rows)))
    assert all(set(row) == {"query", "reference", "score", "unknown"} for row in rows)
    return [row["reference"] for row in rows]


def test_frames_that_cannot_be_read_keep_their_numbers(folders: Path, smal: Smal) -> None:
    Path("ref/img7.png").write_bytes(b"damaged")
    whole = Path("query/img15.png").read_bytes()
    Path("query/img15.png").write_bytes(whole[:-40])
    Path("query/truth.txt").touch()
    status, out, err = smal(
        "match", "ref", "query", "--json", "out.json", "--length", "1", "--truth", "truth.csv"
    )
    assert status == 0
    assert err.splitlines() == [
        "smal: ref: skipped 1, unreadable (numbers kept): img7.png",
        "smal: query: skipped 1, no images: truth.txt",
        "smal: query: skipped 1, unreadable (numbers kept): img15.png",
    ]
    written = json.loads(Path("out.json").read_text())
    found = references_of(written)
    assert found[15] is None
    assert found[7] not in {None, 7}  # the frame of this place cannot be seen
    assert [found[place] for place in range(FRAMES) if place not in {7, 15}] == [
        place for place in range(FRAMES) if place not in {7, 15}
    ]
    assert (written["unreadable_references"], written["unreadable_queries"]) == (
        ["img7.png"],
        ["img15.png"],
    )
    assert "23 of 24 query frames" in out
    assert "24 frames (1 of them unreadable) in ref" in out


def test_depth_is_read_from_its_own_folders(folders: Path, smal: Smal) -> None:
    for name in ("ref", "query"):
        Path(f"{name}-depth").mkdir()
        for place, file in enumerate(NAMES):
            cv2.imwrite(f"{name}-depth/{file}", 200 * view(place)[..., 0].astype(np.uint16))
            cv2.imwrite(
                f"{name}/{file}", np.full((48, 64, 3), 99, np.uint8)
            )  # nothing to see but depth
    arguments = "--modalities depth --reference-depth ref-depth --query-depth query-depth"
    assert references_of(matched(smal, f"{arguments} --length 1")) == list(range(FRAMES))


@pytest.mark.parametrize(
    ("arguments", "status", "line"),
    [
        (["none", "query"], 2, "REFERENCES none: No such file or directory"),
        (["ref", "damaged"], 1, "damaged: no readable image: a.png"),
        (["ref", "query", "--length", "25"], 1, "ref: 24 images, too few for a window of 25; choose a shorter"),
        (["ref", "query", "--json", "query/img3.png"], 2, "--json query/img3.png: is in an input folder"),
        (["ref", "query", "--method", "x"], 2, "--method x: not found; choose from smal, own"),
        (["ref", "query", "--online", "0"], 2, "--online 0: unsupported: scores of the method smal"),
        (["ref", "query", "--precision", "0.9"], 2, "--precision 0.9: unsupported: scores of the method smal are"),
        (["ref", "query", "--method", "own", "--length", "2"], 2, "--length 2: unsupported: the method own"),
        (["ref", "query", "--modalities", "x"], 2, "unknown feature modality 'x'; known are "),
        (["ref", "query", "--truth", "short.csv"], 2, "--truth short.csv: line 2: query 24 is too large"),
        (["ref", "query", "--truth", "truth.csv", "--json", "truth.csv"], 2, "--json truth.csv: is an input of this"),
        (["ref"], 2, "QUERIES: missing"),
        (["ref", "query", "--truth", "gps"], 2, "--radius: missing"),
        (["ref", "query", "--radius", "1"], 2, "--radius: requires"),
        (["ref", "query", "--truth", "gps", "--radius", "1"], 2, "--truth gps: no EXIF position in the images of ref"),
        (["ref", "query", "--poses", "nan.csv", "nan.csv", "--radius", "1"], 2, "--poses nan.csv: line 2: x_m and y_m"),
        (["ref", "truth.csv"], 1, "QUERIES truth.csv: neither a folder of images, nor a recording"),
        (["ref", "query", "--page", "x.png", "--plot", "x.png"], 2, "--plot x.png: same file as --page"),
        (["ref", "query", "--plot", "x.bmp"], 2, "--plot x.bmp: unsupported; the file name"),
        (["ref", "query", "--modalities", "depth"], 2, "--reference-depth: requires the modality depth"),
        (["ref", "query", "--modalities", "depth", "--reference-depth", "ref", "--query-depth", "damaged"], 2,
         "--query-depth damaged: 1 images, but query has 24"),
    ],
)  # fmt: skip
def test_mistakes_are_one_line(
    arguments: list[str], status: int, line: str, folders: Path, mistake: Mistake
) -> None:
    (folders / "damaged").mkdir()
    (folders / "damaged" / "a.png").touch()
    (folders / "nan.csv").write_text("frame,x_m,y_m\n0,nan,0\n")
    (folders / "short.csv").write_text("query,reference_first,reference_last\n24,0,0\n")
    assert line in mistake(status, "match", *arguments)
    assert not (folders / "x.png").exists()


@pytest.mark.parametrize(
    ("raised", "status", "line"),
    [
        (KeyboardInterrupt(), 130, "interrupted"),
        (ValueError("these cannot be"), 1, "cannot match these traverses: these cannot be"),
        (MemoryError(), 1, "out of memory while matching 24 and 24 frames"),
    ],
)
def test_match_keeps_old_file_when_interrupted(
    raised: BaseException,
    status: int,
    line: str,
    folders: Path,
    mistake: Mistake,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def fail(*_: object) -> Matches:
        raise raised

    monkeypatch.setattr(match, "METHODS", table_of(smal=Method("fails.", COLOUR, fail, LENGTH)))
    Path("out.json").write_text("as it was")
    said = mistake(status, "match", "ref", "query", "--json", "out.json", "--plot", "out.png")
    assert said == f"smal: {line}\n"
    assert Path("out.json").read_text() == "as it was"
    assert not Path("out.png").exists()


def test_probable_matches_are_calibrated_and_drawn(
    folders: Path, smal: Smal, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(match, "METHODS", METHODS)
    for name in NAMES[:8]:
        Path(f"ref/{name}").unlink()
    unknown: list[tuple[int, int | str, int | str]] = [(place, "", "") for place in range(8)]
    write_truth([*unknown, *[(place, place - 8, place - 8) for place in range(8, FRAMES)]])
    for online in ("", "--online 2"):
        told = "--tolerance 1 --precision 0.9 --truth truth.csv --plot out.svg"
        written = matched(smal, f"{told} {online}")
        assert {"calibration_error", "known_from_unknown", "auc_95"} <= set(written)
        assert references_of(written)[20] in {None, 11, 12, 13}
        assert written["precision"] == 0.9
    assert Path("out.svg").stat().st_size > 1000


def test_a_traverse_is_a_video_or_a_recording_as_well(folders: Path, smal: Smal) -> None:
    video = cv2.VideoWriter("query.avi", cv2.VideoWriter_fourcc(*"MJPG"), 10.0, (96, 72))
    started = event("query", 0, "started")
    recording = EpisodeWriter.begin(Path(), started)
    recording.write(started)
    for place in range(6, FRAMES):
        video.write(view(place))
        jpeg = encode_jpeg(cv2.cvtColor(view(place), cv2.COLOR_BGR2RGB))
        recording.write(
            CompressedImage.after(header("query", place), width=96, height=72, data=jpeg)
        )
    video.release()
    recording.seal()
    for source in ("query.avi", "query.mcap"):
        status, _, err = smal("match", "ref", source, "--length", "1", "--json", "out.json")
        assert (status, err) == (0, "")
        assert references_of(json.loads(Path("out.json").read_text())) == list(range(6, FRAMES))


def test_truth_is_told_by_names_gps_or_poses(folders: Path, smal: Smal) -> None:
    """Two queries have other names or an unknown place."""
    for name in ("ref", "query"):
        rows = [f"{place},{place},0" for place in range(FRAMES) if name == "ref" or place > 1]
        Path(f"{name}.csv").write_text("\n".join(["frame,x_m,y_m", *rows]))
        for place, file in enumerate(NAMES):
            tags = Image.Exif()
            south = (33.0, 51.0, place * 0.0323)  # A metre a frame.
            tags[0x8825] = {1: "S", 2: south, 3: "E", 4: (151.0, 12.0, 0.0)}
            if name == "ref" or place > 1:
                Image.open(f"{name}/{file}").save(f"{name}/{file}", exif=tags)
    for place in (0, 1):
        Path(f"query/{NAMES[place]}").rename(f"query/a{place}.png")
    for told in ("names", "gps --radius 1.5", "--poses ref.csv query.csv --radius 1.5"):
        arguments = told if told.startswith("--") else f"--truth {told}"
        written = matched(smal, f"--length 1 {arguments}")
        assert (written["judged"], written["auc"]) == (FRAMES - 2, 1.0)
        assert written["tolerance"] is None


def test_features_are_kept_and_a_damaged_cache_is_begun_anew(
    folders: Path, smal: Smal, monkeypatch: pytest.MonkeyPatch
) -> None:
    described: list[object] = []

    def extract(*inputs: Any) -> NDArray[np.float32]:
        described.append(inputs)
        return smal_extract(*inputs)

    def refused(*_: object) -> None:
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))

    def run() -> tuple[int, str]:
        described.clear()
        feature_cache.FeatureCache._said.clear()
        status, _, err = smal("match", "ref", "query")
        assert status == 0
        return len(described), err

    monkeypatch.setattr(traverse, "extract", extract)
    file = feature_cache.cache_file()
    assert run() == (2 * FRAMES, "")
    assert run() == (0, "")
    cv2.imwrite("query/img3.png", view(0))  # is known already: of another name, but not so dark
    assert run() == (0, "")
    for damage in (b"no database", file.read_bytes().replace(b"\x3c", b"\x3d")):
        file.write_bytes(damage)
        count, err = run()
        assert count > 0
        assert err.startswith(f"smal: cache {file}: ")
        assert len(err.splitlines()) == 1
        assert run() == (0, "")
    file.write_bytes(b"no database")
    with monkeypatch.context() as read_only:
        read_only.setattr(Path, "unlink", refused)
        count, err = run()
    assert count == 2 * FRAMES
    assert "file is not a database; features are not cached" in err
    assert len(err.splitlines()) == 1
    monkeypatch.setattr(
        feature_cache, "cache_file", lambda: folders / "truth.csv" / "features.sqlite"
    )
    count, err = run()
    assert count == 2 * FRAMES
    assert "; features are not cached" in err
    assert len(err.splitlines()) == 1


def test_the_cache_does_not_grow_beyond_its_bound(
    folders: Path, smal: Smal, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(feature_cache, "MOST_IMAGES", 10)
    monkeypatch.setattr(feature_cache, "_AT_ONCE", 4)
    status, _, err = smal("match", "ref", "query")
    assert (status, err) == (0, "")
    assert 40_000 < feature_cache.cache_file().stat().st_size < 150_000  # of 48 they are 221,000


def test_loops_are_edges_between_frames_far_apart(
    folders: Path, smal: Smal, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(match, "METHODS", METHODS)
    for place, file in enumerate(NAMES):
        cv2.imwrite(f"ref/lap2-{file}", view(place))
    status, _, err = smal("match", "ref", "--loops", "loops.g2o", "--tolerance", "1")
    assert (status, err) == (0, "")
    edges = [line.split() for line in Path("loops.g2o").read_text().splitlines()]
    assert len(edges) > FRAMES // 2
    assert all(edge[0] == "EDGE_SE2" and len(edge) == 12 for edge in edges)
    assert all(abs(int(later) - int(earlier) - FRAMES) <= 1 for _, earlier, later, *_ in edges)


def test_match_page_exports_truth_when_a_person_judges(
    folders: Path, smal: Smal, browser: Browser
) -> None:
    status, _, _ = smal("match", "ref", "query", "--length", "1", "--page", "page.html")
    assert status == 0
    page = browser.new_page()
    page.goto((folders / "page.html").as_uri())
    cards = page.locator("fieldset")
    assert cards.count() == FRAMES
    cards.nth(0).get_by_label("the same place").check()
    cards.nth(1).get_by_label("right reference").fill("99")
    cards.nth(2).get_by_label("no reference").check()
    with page.expect_download() as download:
        page.click("#save")
    download.value.save_as("judged.csv")
    page.close()
    assert matched(smal, "--length 1 --truth judged.csv")["judged"] == 3


def test_without_a_file_some_matches_are_printed(folders: Path, smal: Smal) -> None:
    status, out, _ = smal("match", "ref", "query", "--tau", "0.999")
    assert status == 0
    assert "12 of 24 query frames; --json FILE writes every match" in out
    assert out.count("img") >= 12

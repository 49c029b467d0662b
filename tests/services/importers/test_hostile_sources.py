"""Whatever somebody's file holds, the answer is one clear line or a count, and nothing outside of it is read."""

import json
import os
import sqlite3
import struct
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from services.importers.drive import ImportFailure
from services.importers.inside import Inside
from services.kit.jpeg import encode_jpeg
from tests.fuzz.targets import check_line
from tests.services.importers import bags, sources
from tests.services.importers.sources import CAMERA
from tests.services.importers.test_folders import LAYOUTS, film
from tests.services.importers.test_formats import (
    FORMATS,
    FRAMES,
    MADE,
    check_drive,
    episode_of,
    imported,
)

pa = pytest.importorskip("pyarrow", reason="needs the extra formats")
NOTHING_ZIPPED = b"PK\x05\x06" + bytes(18)  # The end of a zip file, and nothing before it.
INFO = "meta/info.json"
LINES = "meta/episodes.jsonl"
CATALOG = "catalog_0.catalog"
DATA = "data/chunk-000/file-000.parquet"
EPISODES = "meta/episodes/chunk-000/file-000.parquet"
VIDEO = f"videos/{CAMERA}/chunk-000/file-000.mp4"


def refused(path: Path, form: str, tmp_path: Path) -> str:
    with pytest.raises(ImportFailure) as failure:
        imported(path, form, tmp_path / "out")
    check_line(failure.value)
    assert list((tmp_path / "out").iterdir()) == []
    return str(failure.value)


def replaced(file: Path, old: str, new: str) -> None:
    assert old in file.read_text()
    file.write_text(file.read_text().replace(old, new))


DAMAGES: dict[str, Callable[[bytes], bytes]] = {
    "empty": lambda _data: b"",
    "zip of nothing": lambda _data: NOTHING_ZIPPED,
    "noise": lambda data: np.random.default_rng(1).bytes(len(data)),
    "zeros": lambda data: bytes(len(data)),
    "half": lambda data: data[: len(data) // 2],
    "its end is noise": lambda data: data[:-40] + np.random.default_rng(2).bytes(40),
}
FILES: list[tuple[str, Callable[[Path], Path], str]] = [
    ("donkeycar", sources.donkeycar, "manifest.json"),
    ("donkeycar", sources.donkeycar, CATALOG),
    ("folder", sources.csv_folder, "drive.csv"),
    ("lerobot", sources.lerobot, INFO),
    ("lerobot", sources.lerobot, EPISODES),
    ("lerobot", sources.lerobot, DATA),
    ("lerobot", sources.lerobot, VIDEO),
    ("lerobot", lambda path: sources.lerobot(path, "v2.1", video=False), LINES),
    ("donkeycar", sources.first_tub, "meta.json"),
    ("donkeycar", sources.first_tub, "record_7.json"),
    ("folder", LAYOUTS["tum"], "rgb.txt"),
    ("folder", LAYOUTS["tum"], "groundtruth.txt"),
    ("folder", LAYOUTS["kitti"], "times.txt"),
    ("folder", LAYOUTS["kitti"], "00.txt"),
    ("folder", LAYOUTS["kitti-raw"], "oxts/timestamps.txt"),
    ("folder", LAYOUTS["kitti-raw"], "oxts/data/0000000003.txt"),
    ("folder", LAYOUTS["euroc"], "mav0/cam0/data.csv"),
    ("folder", LAYOUTS["euroc"], "mav0/state_groundtruth_estimate0/data.csv"),
    ("folder", film, "drive.mp4"),
    ("rosbag2", sources.rosbag2, "bag.mcap"),
    ("rosbag2", lambda path: sources.rosbag2(path, sqlite=True), "bag.db3"),
    ("rosbag1", bags.old, "old.bag"),
]


@pytest.mark.parametrize(
    ("form", "make", "name"),
    FILES,
    ids=[f"{form}-{name.replace('/', '-')}" for form, _, name in FILES],
)
def test_import_reports_or_counts_damage(
    form: str, make: Callable[[Path], Path], name: str, tmp_path: Path
) -> None:
    file = make(tmp_path / "bag") / name
    whole = file.read_bytes()
    for damage, change in DAMAGES.items():
        file.write_bytes(change(whole))
        try:
            _, tally = imported(tmp_path / "bag", form, tmp_path / "out")
        except ImportFailure as failure:
            check_line(failure)
            continue
        assert damage in ("half", "its end is noise") or name == "record_7.json"
        for line in tally.lines():
            check_line(line)


@pytest.mark.parametrize("form", FORMATS)
def test_import_reports_missing_files(form: str, tmp_path: Path) -> None:
    assert "no such file or directory" in refused(tmp_path / "none", form, tmp_path).lower()
    (tmp_path / "empty").mkdir()
    assert str(tmp_path / "empty") in refused(tmp_path / "empty", form, tmp_path)


NAMES = {
    "up": "../secret.jpg", "link": "link.jpg", "linked folder": "more/secret.jpg", "nothing": ".", "zero": "a\x01b",
    "long": "x" * 5000,
}  # fmt: skip


@pytest.mark.parametrize("way", ["absolute", *NAMES])
def test_no_image_outside_of_the_folder_is_read(way: str, tmp_path: Path) -> None:
    hidden = tmp_path / "secret.jpg"
    hidden.write_bytes(encode_jpeg(np.full((48, 64, 3), (255, 0, 0), np.uint8)))
    folder = sources.csv_folder(tmp_path / "set")
    (folder / "link.jpg").symlink_to(hidden)
    (folder / "more").symlink_to(tmp_path)
    for name in ("0000.jpg", "0010.jpg"):
        replaced(folder / "drive.csv", name, NAMES.get(way, str(hidden)))
    report, tally = imported(folder, "folder", tmp_path / "out")
    assert tally.counts["images cannot be read"] == 2
    if way in ("absolute", "up", "link", "linked folder"):
        assert [line for line in tally.lines() if "leads out of" in line]
    for line in tally.lines():
        check_line(line)
    assert hidden.read_bytes() not in Path(report.files[0]).read_bytes()
    assert 0 not in episode_of(report).images


def test_a_catalog_outside_of_the_tub_and_a_pipe_are_not_read(tmp_path: Path) -> None:
    tub = sources.donkeycar(tmp_path / "tub")
    (tmp_path / "private").write_text("secret words\n")
    replaced(tub / "manifest.json", CATALOG, "../private")
    said = refused(tub, "donkeycar", tmp_path)
    assert "leads out of" in said
    assert "secret words" not in said
    os.mkfifo(tub / "pipe")
    replaced(tub / "manifest.json", "../private", "pipe")
    assert "Not a regular file" in refused(tub, "donkeycar", tmp_path)


@pytest.mark.parametrize("suffix", ["mcap", "db3"])
def test_a_bag_that_is_a_link_out_of_its_folder_is_not_read(suffix: str, tmp_path: Path) -> None:
    (file,) = sources.rosbag2(tmp_path / "real", sqlite=suffix == "db3").glob(f"*.{suffix}")
    (tmp_path / "bag").mkdir()
    (tmp_path / f"bag/bag.{suffix}").symlink_to(file)
    assert "leads out of" in refused(tmp_path / "bag", "rosbag2", tmp_path)


@pytest.mark.parametrize(
    "text",
    ["#EXTM3U\n#EXTINF:9,\nfile://{0}\n#EXT-X-ENDLIST\n", "ffconcat version 1.0\nfile '{0}'\n"],
)
def test_import_opens_no_files_when_video_is_a_playlist(text: str, tmp_path: Path) -> None:
    dataset = sources.lerobot(tmp_path / "set")
    (dataset / VIDEO).rename(tmp_path / "elsewhere.mp4")
    (dataset / VIDEO).write_text(text.format(tmp_path / "elsewhere.mp4"))
    assert "not a readable video" in refused(dataset, "lerobot", tmp_path)


def png_that_claims(width: int, height: int) -> bytes:
    def chunk(kind: bytes, data: bytes) -> bytes:
        return (
            struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        )

    pixels = zlib.compress(bytes(10_000_000), 9)
    head = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", pixels) + chunk(b"IEND", b"")
    )


def jpeg_that_claims(pixels: int) -> bytes:
    jpeg = encode_jpeg(sources.drive()[0].image)
    at = jpeg.index(b"\xff\xc0") + 5
    return jpeg[:at] + pixels.to_bytes(2, "big") * 2 + jpeg[at + 4 :]


def test_import_encodes_jpeg_with_fill_bytes_again(tmp_path: Path) -> None:
    folder = sources.csv_folder(tmp_path / "set", 10.0)
    for file in folder.glob("*.jpg"):
        data = file.read_bytes()
        file.write_bytes(data[:2] + b"\xff" + data[2:])
    report, tally = imported(folder, "folder", tmp_path / "out")
    check_drive(episode_of(report))
    assert tally.counts["images are JPEG of a rare form, encoded again"] == len(MADE)


def test_refusal_ignores_the_neighbours_of_a_file(tmp_path: Path) -> None:
    sources.donkeycar(tmp_path / "data/tub")
    (tmp_path / "notes.txt").touch()
    said = refused(tmp_path / "notes.txt", "folder", tmp_path)
    assert "a file, not of the format folder" in said
    assert "donkeycar" not in said


def test_empty_dataset_has_no_drives(tmp_path: Path) -> None:
    dataset = sources.lerobot(tmp_path / "set", "v2.1", video=False)
    (dataset / LINES).write_text("")
    assert "no drives in this source" in refused(dataset, "lerobot", tmp_path)


def test_import_counts_invalid_images(tmp_path: Path) -> None:
    images = [
        png_that_claims(30_000, 30_000), png_that_claims(4000, 3000), png_that_claims(0, 0), png_that_claims(2**31, 1),
        jpeg_that_claims(32_700), encode_jpeg(sources.drive()[0].image)[:-300],
        encode_jpeg(np.zeros((8, 8, 3), np.uint8)), encode_jpeg(np.zeros((24, 5000, 3), np.uint8)), b"GIF89a", b"",
        b"\xff\xd8", NOTHING_ZIPPED,
    ]  # fmt: skip
    folder = sources.csv_folder(tmp_path / "set", 10.0)
    for number, data in enumerate(images):
        (folder / f"{number + 4:04d}.jpg").write_bytes(data)
    report, tally = imported(folder, "folder", tmp_path / "out")
    assert sum(tally.counts.values()) == len(images)
    assert set(range(len(MADE))) - set(episode_of(report).images) == {
        4 + k for k in range(len(images))
    }


NUMBERS = ["NaN", "Infinity", "-Infinity", "1e400", '"fast"', "null", "[]", "{}"]
NUMBERS += ["1" * 400, "[" * 2000 + "]" * 2000]


@pytest.mark.parametrize("field", ["_index", "_timestamp_ms", "user/angle", "user/throttle"])
def test_import_counts_invalid_numbers_of_a_tub(field: str, tmp_path: Path) -> None:
    tub = sources.donkeycar(tmp_path / "tub")
    lines = (tub / CATALOG).read_text().splitlines()
    for row, number in enumerate(NUMBERS):
        lines[2 * row] = json.dumps(json.loads(lines[2 * row]) | {field: "HERE"}).replace(
            '"HERE"', number
        )
    (tub / CATALOG).write_text("\n".join(lines))
    _, tally = imported(tub, "donkeycar", tmp_path / "out")
    assert tally.counts["records lack an image, an angle, a throttle or a time"] == len(NUMBERS)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('"v3.0"', '"v9.9\\n\\u001b[2J"', "codebase_version: "),
        ('"fps": 20', '"fps": 0', "fps: "),
        ('"fps": 20', '"fps": 1e400', "fps: "),
        ('"chunks_size": 1000', '"chunks_size": 0', "chunks_size: "),
        (
            '"theta.vel"',
            '"elbow"',
            "no linear and angular velocity of a base in action: arm_wrist.pos, x.vel",
        ),
        ('"video"', '"float32"', "camera: 0 found; choose from none"),
        ('"features"', '"feature"', "features: Field required"),
        (f'"{CAMERA}"', '"../../../../secret"', "lacks the column"),
        (f'"{CAMERA}"', '"{0.__class__}"', "lacks the column"),
    ],
)
def test_a_description_that_says_nonsense_is_named(
    old: str, new: str, said: str, tmp_path: Path
) -> None:
    dataset = sources.lerobot(tmp_path / "set")
    replaced(dataset / INFO, old, new)
    assert said in refused(dataset, "lerobot", tmp_path)


def rewrite(dataset: Path, name: str, change: Callable[[dict[str, Any]], object]) -> None:
    import pyarrow.parquet as pq  # noqa: PLC0415

    rows = pq.read_table(dataset / name).to_pylist()
    for row in rows:
        change(row)
    pq.write_table(pa.Table.from_pylist(rows), dataset / name)


@pytest.mark.parametrize(
    ("name", "change", "said"),
    [
        (DATA, lambda row: row.update(action=[1.0]), "has fewer numbers than"),
        (
            DATA,
            lambda row: row.update(action=[1.0] * (1 + int(20 * row["timestamp"]) % 3)),
            "differ in length",
        ),
        (DATA, lambda row: row.update(action="go"), "is not a column of numbers"),
        (DATA, lambda row: row.update(timestamp="now"), "is not a column of numbers"),
        (DATA, lambda row: row.pop("timestamp"), "lacks the column timestamp"),
        (EPISODES, lambda row: row.update(episode_index=-1), "not numbered from 0"),
        (EPISODES, lambda row: row.update({"data/file_index": 7}), "no such file"),
        (EPISODES, lambda row: row.update({f"videos/{CAMERA}/file_index": 10**15}), "no such file"),
        (
            EPISODES,
            lambda row: row.update({f"videos/{CAMERA}/from_timestamp": np.nan}),
            "not numbered from 0",
        ),
        (EPISODES, lambda row: row.update({"data/chunk_index": 1e300}), "file name too long"),
    ],
)
def test_tables_that_say_nonsense_are_named(
    name: str, change: Callable[[dict[str, Any]], object], said: str, tmp_path: Path
) -> None:
    dataset = sources.lerobot(tmp_path / "set")
    rewrite(dataset, name, change)
    assert said.lower() in refused(dataset, "lerobot", tmp_path).lower()


def test_import_reports_wrong_counts_and_short_video(tmp_path: Path) -> None:
    dataset = sources.lerobot(tmp_path / "set")
    replaced(dataset / INFO, '"total_episodes": 2', '"total_episodes": 99')
    rewrite(dataset, EPISODES, lambda row: row.update(length=10**12))
    _, tally = imported(dataset, "lerobot", tmp_path / "out")
    assert "meta/info.json announces 99 episodes, there are 2" in tally.lines()
    assert f"episode 0: announces 1000000000000 frames, has {FRAMES}" in tally.lines()
    _, tally = imported(
        sources.donkeycar(tmp_path / "tub", announced=10**9), "donkeycar", tmp_path / "out2"
    )
    assert f"the manifest announces 1000000000 records, the catalogs have {FRAMES}" in tally.lines()
    sources.mp4(dataset / VIDEO, [moment.image for moment in sources.drive(20.0)][:40], 20)
    _, tally = imported(dataset, "lerobot", tmp_path / "out3", episodes=("0",))
    assert tally.counts["frames are not in the video"] == 14


def test_catalog_is_read_once_when_the_manifest_repeats_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tub = sources.donkeycar(tmp_path / "tub")
    replaced(
        tub / "manifest.json", f'"{CATALOG}"', ", ".join([f'"{CATALOG}"', f'"./{CATALOG}"'] * 500)
    )
    read: list[str] = []
    lines = Inside.lines

    def counted(inside: Inside, name: str) -> Iterator[bytes]:
        read.append(name)
        return lines(inside, name)

    monkeypatch.setattr(Inside, "lines", counted)
    report, tally = imported(tub, "donkeycar", tmp_path / "out")
    assert len(read) == 1
    assert tally.counts["names of catalogs are repeated (read once)"] == 999
    assert report.ticks == len(MADE)


def test_episode_is_read_once_when_it_is_described_again(tmp_path: Path) -> None:
    dataset = sources.lerobot(tmp_path / "set", "v2.1")
    lines = (dataset / "meta/episodes.jsonl").read_text()
    (dataset / "meta/episodes.jsonl").write_text(lines * 50)
    report, tally = imported(dataset, "lerobot", tmp_path / "out")
    assert len(report.files) == 2
    assert tally.counts["episodes are described again (read once)"] == 98


def test_import_reads_whole_messages_when_bag_end_is_missing(tmp_path: Path) -> None:
    bag = sources.rosbag2(tmp_path / "bag")
    (bag / "bag.mcap").write_bytes((bag / "bag.mcap").read_bytes()[:-30])
    report, tally = imported(bag, "rosbag2", tmp_path / "out")
    assert report.ticks == len(MADE)
    assert "bag.mcap: end missing; only complete messages are read" in tally.lines()


@pytest.mark.parametrize(
    ("statement", "said"),
    [
        ("DROP TABLE messages", "tables of topics and messages not found"),
        ("ALTER TABLE messages RENAME TO real; CREATE VIEW messages AS WITH RECURSIVE r(n) AS (SELECT 1 UNION ALL "
         "SELECT n + 1 FROM r) SELECT n AS id, 1 AS topic_id, n AS timestamp, zeroblob(9) AS data FROM r",
         "tables of topics and messages not found"),
        ("CREATE TABLE stored AS SELECT * FROM messages; DROP TABLE messages; CREATE TABLE messages (id INTEGER, "
         "topic_id INTEGER, timestamp INTEGER, raw BLOB, data BLOB AS (hex(zeroblob(length(raw)))) VIRTUAL); "
         "INSERT INTO messages SELECT id, topic_id, timestamp, data FROM stored",
         "the column data of messages is computed, not stored"),
        ("DROP TABLE messages; CREATE VIRTUAL TABLE messages USING fts4(topic_id, timestamp, data)",
         "tables of topics and messages not found"),
        ("CREATE TABLE stored AS SELECT * FROM messages; DROP TABLE messages; CREATE TABLE messages (id INTEGER, "
         "topic_id INTEGER, timestamp INTEGER); INSERT INTO messages SELECT id, topic_id, timestamp FROM stored; "
         "ALTER TABLE messages ADD COLUMN data BLOB DEFAULT X'" + "00" * 100_000 + "'",
         "its messages are larger than the file"),
        ("UPDATE topics SET serialization_format = 'json'", "unsupported encoding json of topics, not ROS 2's CDR"),
        ("UPDATE topics SET type = 'std_msgs/msg/String'", "topic of image"),
        ("UPDATE messages SET data = X'0001'", "topic of image"),
        ("UPDATE messages SET data = X'28B52FFD00'", "topic of image"),
        ("UPDATE messages SET timestamp = 'x'", "topic of image"),
        ("UPDATE messages SET topic_id = 99", "topic of image"),
    ],
    ids=lambda text: text[:60],
)  # fmt: skip
def test_import_rejects_databases_that_are_not_bags(
    statement: str, said: str, tmp_path: Path
) -> None:
    bag = sources.rosbag2(tmp_path / "bag", sqlite=True)
    with sqlite3.connect(bag / "bag.db3") as database:
        database.executescript(statement)
    database.close()
    assert said in refused(bag, "rosbag2", tmp_path)


def test_import_rejects_messages_that_unpack_too_large(tmp_path: Path) -> None:
    from zstandard import ZstdCompressor  # noqa: PLC0415

    bag = sources.rosbag2(tmp_path / "bag", sqlite=True)
    with sqlite3.connect(bag / "bag.db3") as database:
        database.execute(
            "UPDATE messages SET data = ? WHERE id = 3", (ZstdCompressor().compress(bytes(2**26)),)
        )
    database.close()
    assert "packed message too large (more than" in refused(bag, "rosbag2", tmp_path)


COLUMNS = "image,time_s,linear_m_s,angular_rad_s\n"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "lacks the columns"),
        ("image,time_s\n", "lacks the columns angular_rad_s, linear_m_s"),
        (COLUMNS, "no row has"),
        (COLUMNS + "x" * 2_000_000, "line too long (more than"),
        (COLUMNS + '"' + ("x" * 900 + "\n") * 900, "not CSV"),
        (COLUMNS + "0.jpg,nan,1,0\n0.jpg,0,inf,0\n0.jpg,1e999,1,0\n", "no row has"),
        (COLUMNS + "0000.jpg,0,1,0\n0001.jpg,1e300,1,0\n", "not in seconds"),
        (COLUMNS + "0000.jpg,5,0,0\n0001.jpg,6,0,0\n", "the robot never drives"),
    ],
    ids=["empty", "columns", "rows", "line", "quote", "numbers", "times", "still"],
)
def test_import_rejects_invalid_tables(text: str, said: str, tmp_path: Path) -> None:
    folder = sources.csv_folder(tmp_path / "set")
    (folder / "drive.csv").write_text(text)
    assert said in refused(folder, "folder", tmp_path)


def test_import_rejects_own_recordings(tmp_path: Path) -> None:
    bag = sources.rosbag2(tmp_path / "bag")
    report, _ = imported(bag, "rosbag2", tmp_path / "recordings")
    said = refused(Path(report.files[0]), "rosbag2", tmp_path)
    assert "among none; " in said
    assert "unsupported encoding json of topics, not ROS 2's CDR" in said

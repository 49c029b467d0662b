"""Whatever somebody's file holds, the answer is one clear line or a count, and nothing outside of it is read."""

from __future__ import annotations

import json
import os
import sqlite3
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from services.importers.drive import ImportFailure
from services.kit.jpeg import encode_jpeg
from tests.fuzz.targets import check_line
from tests.services.importers import sources
from tests.services.importers.test_formats import episode_of, imported

pa = pytest.importorskip("pyarrow", reason="needs the extra formats")
#: The end of a zip file, and nothing before it.
NOTHING_ZIPPED = b"PK\x05\x06" + bytes(18)
KEY = "observation.images.front"


def refused(path: Path, form: str, tmp_path: Path) -> str:
    with pytest.raises(ImportFailure) as failure:
        imported(path, form, tmp_path / "out")
    check_line(failure.value)
    assert list((tmp_path / "out").iterdir()) == []
    return str(failure.value)


Damage = Callable[[bytes], bytes]
DAMAGES: dict[str, Damage] = {
    "empty": lambda _data: b"",
    "zip of nothing": lambda _data: NOTHING_ZIPPED,
    "half": lambda data: data[: len(data) // 2],
    "noise": lambda data: np.random.default_rng(1).bytes(len(data)),
    "a byte changed": lambda data: (
        data[: len(data) // 2] + bytes([data[len(data) // 2] ^ 0xFF]) + data[len(data) // 2 + 1 :]
    ),
    "zeros": lambda data: bytes(len(data)),
    "its end is noise": lambda data: data[:-40] + np.random.default_rng(2).bytes(40),
}
FILES: list[tuple[str, Callable[[Path], Path], str]] = [
    ("donkeycar", sources.donkeycar, "manifest.json"),
    ("donkeycar", sources.donkeycar, "catalog_0.catalog"),
    ("folder", sources.csv_folder, "drive.csv"),
    ("lerobot", sources.lerobot, "meta/info.json"),
    ("lerobot", sources.lerobot, "meta/episodes/chunk-000/file-000.parquet"),
    ("lerobot", sources.lerobot, "data/chunk-000/file-000.parquet"),
    ("lerobot", sources.lerobot, f"videos/{KEY}/chunk-000/file-000.mp4"),
    ("lerobot", lambda path: sources.lerobot(path, "v2.1"), "meta/episodes.jsonl"),
    ("lerobot", lambda path: sources.lerobot(path, "v2.1", video=False), "data/chunk-000/episode_000000.parquet"),
    ("rosbag2", sources.rosbag2, "bag.mcap"),
    ("rosbag2", lambda path: sources.rosbag2(path, sqlite=True), "bag.db3"),
]


@pytest.mark.parametrize("damage", DAMAGES)
@pytest.mark.parametrize(("form", "make", "name"), FILES, ids=[f"{form}-{Path(name).name}" for form, _, name in FILES])
def test_a_damaged_file_is_one_line_or_counted(
    form: str, make: Callable[[Path], Path], name: str, damage: str, tmp_path: Path
) -> None:
    source = make(tmp_path / "bag")
    file = source / name
    file.write_bytes(DAMAGES[damage](file.read_bytes()))
    try:
        _, tally = imported(source, form, tmp_path / "out")
    except ImportFailure as failure:
        check_line(failure)
        return
    assert damage not in ("empty", "zip of nothing", "noise", "zeros")
    for line in tally.lines():
        check_line(line)


@pytest.mark.parametrize("form", ["donkeycar", "folder", "lerobot", "rosbag2"])
def test_what_is_not_there_is_named(form: str, tmp_path: Path) -> None:
    assert "no such file or directory" in refused(tmp_path / "none", form, tmp_path).lower()
    (tmp_path / "empty").mkdir()
    assert str(tmp_path / "empty") in refused(tmp_path / "empty", form, tmp_path)


def secret(tmp_path: Path) -> Path:
    """Make an image beside the source, all of one colour, which must not get into a recording."""
    path = tmp_path / "secret.jpg"
    path.write_bytes(encode_jpeg(np.full((48, 64, 3), (255, 0, 0), np.uint8)))
    return path


@pytest.mark.parametrize("way", ["up", "absolute", "link", "linked folder"])
def test_no_image_outside_of_the_folder_is_read(way: str, tmp_path: Path) -> None:
    hidden = secret(tmp_path)
    folder = sources.csv_folder(tmp_path / "set")
    (folder / "link.jpg").symlink_to(hidden)
    (folder / "more").symlink_to(tmp_path)
    named = {"up": "../secret.jpg", "absolute": str(hidden), "link": "link.jpg", "linked folder": "more/secret.jpg"}
    text = (folder / "drive.csv").read_text()
    (folder / "drive.csv").write_text(text.replace("0000.jpg", named[way]).replace("0010.jpg", named[way]))
    report, tally = imported(folder, "folder", tmp_path / "out")
    assert tally.counts["images are outside of the folder"] == 2
    assert hidden.read_bytes() not in Path(report.files[0]).read_bytes()
    assert 0 not in episode_of(report).images


@pytest.mark.parametrize("name", ["../../etc/passwd", "/etc/passwd", "a\x00b", "x" * 5000, "", ".", "\x1b[2J"])
def test_names_that_are_none_are_counted(name: str, tmp_path: Path) -> None:
    def change(record: dict[str, Any]) -> None:
        if record["_index"] == 4:
            record["cam/image_array"] = name

    _, tally = imported(sources.donkeycar(tmp_path / "tub", change=change), "donkeycar", tmp_path / "out")
    assert sum(count for what, count in tally.counts.items() if what.startswith("images")) == 1
    for line in tally.lines():
        check_line(line)


def test_a_catalog_outside_of_the_tub_is_not_read(tmp_path: Path) -> None:
    tub = sources.donkeycar(tmp_path / "tub")
    (tmp_path / "private").write_text("secret words\n")
    text = (tub / "manifest.json").read_text()
    (tub / "manifest.json").write_text(text.replace("catalog_0.catalog", "../private"))
    said = refused(tub, "donkeycar", tmp_path)
    assert "leads out of" in said
    assert "secret words" not in said


def test_a_pipe_is_not_waited_for(tmp_path: Path) -> None:
    tub = sources.donkeycar(tmp_path / "tub")
    (tub / "catalog_0.catalog").unlink()
    os.mkfifo(tub / "catalog_0.catalog")
    assert "is no regular file" in refused(tub, "donkeycar", tmp_path)


@pytest.mark.parametrize("suffix", ["mcap", "db3"])
def test_a_bag_that_is_a_link_out_of_its_folder_is_not_read(suffix: str, tmp_path: Path) -> None:
    (file,) = sources.rosbag2(tmp_path / "real", sqlite=suffix == "db3").glob(f"*.{suffix}")
    (tmp_path / "bag").mkdir()
    (tmp_path / f"bag/bag.{suffix}").symlink_to(file)
    assert "leads out of" in refused(tmp_path / "bag", "rosbag2", tmp_path)


def test_a_playlist_that_calls_itself_a_video_opens_nothing(tmp_path: Path) -> None:
    dataset = sources.lerobot(tmp_path / "set")
    video = dataset / f"videos/{KEY}/chunk-000/file-000.mp4"
    elsewhere = tmp_path / "elsewhere.mp4"
    video.rename(elsewhere)
    for text in (
        f"#EXTM3U\n#EXT-X-TARGETDURATION:9\n#EXTINF:9,\nfile://{elsewhere}\n#EXT-X-ENDLIST\n",
        f"ffconcat version 1.0\nfile '{elsewhere}'\n",
    ):
        video.write_text(text)
        assert "not a video that can be read" in refused(dataset, "lerobot", tmp_path)


def png_that_claims(width: int, height: int) -> bytes:
    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    pixels = zlib.compress(bytes(10_000_000), 9)
    head = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", pixels) + chunk(b"IEND", b"")


def jpeg_that_claims(pixels: int) -> bytes:
    jpeg = encode_jpeg(sources.drive()[0].image)
    at = jpeg.index(b"\xff\xc0") + 5
    return jpeg[:at] + pixels.to_bytes(2, "big") * 2 + jpeg[at + 4 :]


@pytest.mark.parametrize(
    "data",
    [
        png_that_claims(30_000, 30_000), png_that_claims(4000, 3000), png_that_claims(0, 0), png_that_claims(2**31, 1),
        jpeg_that_claims(32_700), encode_jpeg(sources.drive()[0].image)[:-300],
        encode_jpeg(np.zeros((8, 8, 3), np.uint8)), encode_jpeg(np.zeros((24, 5000, 3), np.uint8)), b"GIF89a", b"",
        b"\xff\xd8", NOTHING_ZIPPED,
    ],
    ids=["png-900-megapixels", "png-4000x3000-of-nothing", "png-0x0", "png-two-billion-wide", "jpeg-one-gigapixel",
         "jpeg-half", "jpeg-8x8", "jpeg-5000-wide", "gif", "empty", "marker", "zip"],
)  # fmt: skip
def test_an_image_that_is_none_is_counted(data: bytes, tmp_path: Path) -> None:
    folder = sources.csv_folder(tmp_path / "set", 10.0)
    (folder / "0004.jpg").write_bytes(data)
    report, tally = imported(folder, "folder", tmp_path / "out")
    assert sum(tally.counts.values()) == 1
    assert sorted(set(range(report.ticks + 1)) - set(episode_of(report).images)) == [4]


NUMBERS = ["NaN", "Infinity", "-Infinity", "1e400", '"fast"', "null", "[]", "{}", "1" * 400, "[" * 2000 + "]" * 2000]


@pytest.mark.parametrize("number", NUMBERS, ids=lambda number: number[:12])
@pytest.mark.parametrize("field", ["_index", "_timestamp_ms", "user/angle", "user/throttle"])
def test_a_number_of_a_tub_that_is_none_is_counted(field: str, number: str, tmp_path: Path) -> None:
    tub = sources.donkeycar(tmp_path / "tub")
    lines = (tub / "catalog_0.catalog").read_text().splitlines()
    record = json.loads(lines[5])
    lines[5] = json.dumps(record | {field: "HERE"}).replace('"HERE"', number)
    (tub / "catalog_0.catalog").write_text("\n".join(lines))
    _, tally = imported(tub, "donkeycar", tmp_path / "out")
    assert sum(count for what, count in tally.counts.items() if what.startswith("records")) <= 1
    # A number of four hundred digits is one, to which only the index has a bound.
    assert tally.counts["records lack an image, an angle, a throttle or a time"] == 1 or field == "_index"


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('"v3.0"', '"v9.9\\n\\u001b[2J"', "version v9.9"),
        ('"fps": 20', '"fps": 0', "not those of a camera"),
        ('"fps": 20', '"fps": 1e400', "not those of a camera"),
        ('"chunks_size": 1000', '"chunks_size": 0', "not those of a camera"),
        ('"theta.vel"', '"elbow"', "neither action nor observation.state"),
        ('"video"', '"float32"', "0 cameras (none)"),
        ('"features"', '"feature"', "lacks codebase_version, fps or features"),
        ('"action"', '"reward"', "neither action nor observation.state"),
        (f'"{KEY}"', '"../../../../secret"', "columns"),
        (f'"{KEY}"', '"{0.__class__}"', "columns"),
    ],
)
def test_a_description_that_says_nonsense_is_named(old: str, new: str, said: str, tmp_path: Path) -> None:
    dataset = sources.lerobot(tmp_path / "set")
    info = dataset / "meta/info.json"
    assert old in info.read_text()
    info.write_text(info.read_text().replace(old, new))
    assert said.replace("columns", "lacks the column") in refused(dataset, "lerobot", tmp_path)


def rewrite(dataset: Path, name: str, change: Callable[[dict[str, Any]], object]) -> None:
    import pyarrow.parquet as pq  # noqa: PLC0415

    rows = pq.read_table(dataset / name).to_pylist()
    for row in rows:
        change(row)
    pq.write_table(pa.Table.from_pylist(rows), dataset / name)


DATA, EPISODES = "data/chunk-000/file-000.parquet", "meta/episodes/chunk-000/file-000.parquet"


@pytest.mark.parametrize(
    ("name", "change", "said"),
    [
        (DATA, lambda row: row.update(action=[1.0]), "has fewer numbers than"),
        (DATA, lambda row: row.update(action=[1.0] * (1 + int(20 * row["timestamp"]) % 3)), "not equally long"),
        (DATA, lambda row: row.update(action="go"), "is not a column of numbers"),
        (DATA, lambda row: row.update(timestamp="now"), "is not a column of numbers"),
        (DATA, lambda row: row.pop("timestamp"), "lacks the column timestamp"),
        (EPISODES, lambda row: row.update(episode_index=-1), "not numbers from 0 on"),
        (EPISODES, lambda row: row.update({"data/file_index": 7}), "no such file"),
        (EPISODES, lambda row: row.update({f"videos/{KEY}/file_index": 10**15}), "no such file"),
        (EPISODES, lambda row: row.update({f"videos/{KEY}/from_timestamp": float("nan")}), "not numbers from 0 on"),
        (EPISODES, lambda row: row.update({"data/chunk_index": 1e300}), "file name too long"),
    ],
)
def test_tables_that_say_nonsense_are_named(
    name: str, change: Callable[[dict[str, Any]], object], said: str, tmp_path: Path
) -> None:
    dataset = sources.lerobot(tmp_path / "set")
    rewrite(dataset, name, change)
    assert said in refused(dataset, "lerobot", tmp_path).replace("File name", "file name")


def test_wrong_counts_are_said(tmp_path: Path) -> None:
    dataset = sources.lerobot(tmp_path / "set")
    info = dataset / "meta/info.json"
    info.write_text(info.read_text().replace('"total_episodes": 2', '"total_episodes": 99'))
    rewrite(dataset, EPISODES, lambda row: row.update(length=10**12))
    _, tally = imported(dataset, "lerobot", tmp_path / "out")
    count = len(sources.drive(20.0))
    assert "meta/info.json announces 99 episodes, there are 2" in tally.lines()
    assert f"episode 0: announces 1000000000000 frames, has {count}" in tally.lines()
    tub = sources.donkeycar(tmp_path / "tub", announced=10**9)
    _, tally = imported(tub, "donkeycar", tmp_path / "out2")
    assert f"the manifest announces 1000000000 records, the catalogs have {count}" in tally.lines()


def test_a_video_that_ends_early_is_counted(tmp_path: Path) -> None:
    dataset = sources.lerobot(tmp_path / "set", episodes=1)
    pixels = [moment.image for moment in sources.drive(20.0)]
    sources.mp4(dataset / f"videos/{KEY}/chunk-000/file-000.mp4", pixels[:40], 20)
    report, tally = imported(dataset, "lerobot", tmp_path / "out")
    assert report.ticks == 20
    assert tally.counts["frames are not in the video"] == 14


def test_a_bag_whose_end_is_missing_gives_its_whole_messages(tmp_path: Path) -> None:
    bag = sources.rosbag2(tmp_path / "bag")
    data = (bag / "bag.mcap").read_bytes()
    (bag / "bag.mcap").write_bytes(data[: len(data) - 30])
    report, tally = imported(bag, "rosbag2", tmp_path / "out")
    assert report.ticks == 34
    assert "bag.mcap: its end is missing; the whole messages are read" in tally.lines()


@pytest.mark.parametrize(
    ("statement", "said"),
    [
        ("DROP TABLE messages", "no tables of topics and messages"),
        ("ALTER TABLE messages RENAME TO real; CREATE VIEW messages AS WITH RECURSIVE r(n) AS (SELECT 1 UNION ALL "
         "SELECT n + 1 FROM r) SELECT n AS id, 1 AS topic_id, n AS timestamp, zeroblob(9) AS data FROM r",
         "no tables of topics and messages"),
        ("UPDATE topics SET serialization_format = 'json'", "topics are json, not ROS 2's CDR"),
        ("UPDATE topics SET type = 'std_msgs/msg/String'", "no topic of image"),
        ("UPDATE messages SET data = X'0001'", "no topic of velocity"),
        ("UPDATE messages SET data = X'28B52FFD00'", "no topic of velocity"),
        ("UPDATE messages SET timestamp = 'x'", "no topic of image"),
        ("UPDATE messages SET topic_id = 99", "no topic of image"),
    ],
)  # fmt: skip
def test_a_database_that_is_no_bag_is_named(statement: str, said: str, tmp_path: Path) -> None:
    bag = sources.rosbag2(tmp_path / "bag", sqlite=True)
    with sqlite3.connect(bag / "bag.db3") as database:
        database.executescript(statement)
    database.close()
    assert said in refused(bag, "rosbag2", tmp_path)


def test_a_packed_message_that_unpacks_to_all_memory_is_named(tmp_path: Path) -> None:
    from zstandard import ZstdCompressor  # noqa: PLC0415

    bag = sources.rosbag2(tmp_path / "bag", sqlite=True)
    bomb = ZstdCompressor().compress(bytes(2**30))
    with sqlite3.connect(bag / "bag.db3") as database:
        database.execute("UPDATE messages SET data = ? WHERE id = 3", (bomb,))
    database.close()
    assert "a packed message of more than" in refused(bag, "rosbag2", tmp_path)


def test_a_bag_of_two_cameras_wants_a_choice(tmp_path: Path) -> None:
    bag = sources.rosbag2(tmp_path / "bag", sqlite=True)
    with sqlite3.connect(bag / "bag.db3") as database:
        database.execute("UPDATE topics SET name = '/odom', type = 'sensor_msgs/msg/Image' WHERE name = '/odom'")
    database.close()
    assert "several topics of image" in refused(bag, "rosbag2", tmp_path)
    assert "choose one with --camera" in refused(bag, "rosbag2", tmp_path)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "lacks the columns"),
        ("image,time_s\n", "lacks the columns angular_rad_s, linear_m_s"),
        ("image,time_s,linear_m_s,angular_rad_s\n", "no row has"),
        ("image,time_s,linear_m_s,angular_rad_s\n" + "x" * 2_000_000, "a line of more than"),
        ('image,time_s,linear_m_s,angular_rad_s\n"' + ("x" * 900 + "\n") * 900, "no CSV"),
        ("image,time_s,linear_m_s,angular_rad_s\n0.jpg,nan,1,0\n0.jpg,0,inf,0\n0.jpg,1e999,1,0\n", "no row has"),
        ("image,time_s,linear_m_s,angular_rad_s\n0000.jpg,0,1,0\n0001.jpg,1e300,1,0\n", "not in seconds"),
        ("image,time_s,linear_m_s,angular_rad_s\n0000.jpg,5,0,0\n0001.jpg,6,0,0\n", "the robot never drives"),
    ],
    ids=["empty", "columns", "rows", "line", "quote", "numbers", "times", "still"],
)
def test_a_table_that_says_nonsense_is_named(text: str, said: str, tmp_path: Path) -> None:
    folder = sources.csv_folder(tmp_path / "set")
    (folder / "drive.csv").write_text(text)
    assert said in refused(folder, "folder", tmp_path)


def test_a_folder_of_bags_says_that_each_is_imported_by_itself(tmp_path: Path) -> None:
    sources.rosbag2(tmp_path / "bags/monday").joinpath("metadata.yaml").write_text("")
    assert "no *.db3 in this folder; monday in it is a bag: import each by itself" in refused(
        tmp_path / "bags", "rosbag2", tmp_path
    )


def test_a_recording_of_our_own_is_no_bag(tmp_path: Path) -> None:
    sources.rosbag2(tmp_path / "bag")
    (tmp_path / "again").mkdir()
    report, _ = imported(tmp_path / "bag", "rosbag2", tmp_path / "out")
    assert "it has: none; " in (said := refused(Path(report.files[0]), "rosbag2", tmp_path / "again"))
    assert "topics are json, not ROS 2's CDR" in said

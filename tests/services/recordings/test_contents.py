"""What is told of recordings, what is found wrong with them, and what a repair saves."""

import json
from collections import Counter
from pathlib import Path

import pytest
from mcap.reader import make_reader

from services.kit.errors import JobError
from services.recordings.contents import contents_of, verify
from services.recordings.reader import read_recording
from services.recordings.repair import repair, usual_name
from services.recordings.sink import partial_of
from services.recordings.stream import RecordingError
from services.recordings.views import is_view
from services.recordings.writer import EpisodeWriter
from tests.services.cli.conftest import Smal
from tests.services.recordings import driven_corridor
from tests.services.recordings.recorded_messages import (
    applied,
    episode,
    event,
    frame,
    image,
)
from tests.services.recordings.test_recorder_files import (
    check,
    leave,
    read_all,
    record,
    stored_in,
    wanted,
)


def mended(path: Path, out: Path) -> Path:
    """Repair; return what came of it, which has no damage any more."""
    _, after = repair([path], out)
    assert (after.state, after.damage) == ("sealed", [])
    check(out)
    return out


def test_info_lists_contents_of_a_recording(tmp_path: Path) -> None:
    path = driven_corridor.record(tmp_path)
    contents = contents_of(path)
    (one,) = contents.episodes
    assert (contents.state, contents.size, contents.findings) == ("sealed", path.stat().st_size, [])
    assert (one.robot, one.episode) == ("teacher", "drive-corridor")
    assert one.said == {
        "world": "corridor", "seed": 0, "purpose": "drive", "goal": "end", "driver": "teleop",
    }  # fmt: skip
    assert (one.outcome, one.judge) == ("found", "operator")
    assert one.drove == {"teleop": 30}
    assert (one.frames, one.seconds) == (30, pytest.approx(2.914))
    assert (one.width, one.height) == (64, 48)
    assert one.field_of_view_deg == pytest.approx(71.08, abs=0.01)
    assert one.odometry_m == pytest.approx(4.1, abs=0.2)
    counts = {name: topic.messages for name, topic in one.topics.items()}
    assert counts == Counter(
        {
            "camera/jpeg": 30, "odometry": 30, "command/applied": 30, "command/teleop": 30,
            "camera/info": 1, "episode": 2,
        }
    )  # fmt: skip
    assert one.topics["odometry"].rate_hz == pytest.approx(29 / 2.914)


def test_contents_are_ordered_when_messages_come_late(tmp_path: Path) -> None:
    started, *rest, ended = episode("drive-1")
    told = []
    for folder, sent in ((tmp_path / "1", rest), (tmp_path / "2", [*rest[1::2], *rest[::2]])):
        folder.mkdir()
        path = record(folder, [started, *sent, ended])
        (known,) = contents_of(path).episodes
        (read,) = read_recording(path).episodes
        told.append(
            (
                known,
                [
                    [(tick, read.atom(tick), read.odometry[tick].pose) for tick in piece.tolist()]
                    for piece in read.pieces()
                ],
            )
        )
    assert told[0] == told[1]


def test_info_reports_file_when_it_is_not_a_recording(tmp_path: Path, smal: Smal) -> None:
    driven_corridor.record(tmp_path)
    record(tmp_path, list(episode("drive-1", outcome="aborted")))
    first, second = json.loads(smal("recording", "info", tmp_path, "--json")[1])
    assert first["episodes"][0]["outcome"] == "aborted"
    assert second["episodes"][0]["topics"]["odometry"]["messages"] == 30
    (tmp_path / "notes.mcap").write_text("shopping list")
    status, text, why = smal("recording", "info", tmp_path)
    assert status == 1
    assert "found (judged by the operator)" in text
    assert why == f"smal: {tmp_path / 'notes.mcap'}: not an MCAP file\n"


def test_each_kind_of_fault_is_one_line(tmp_path: Path, smal: Smal) -> None:
    assert verify(record(tmp_path, list(episode("e")))).findings == []
    sent = [
        message
        for message in episode("e", frames=6)
        if (message.topic_name, message.tick) != ("camera/jpeg", 2)
    ]
    writer = EpisodeWriter.begin(tmp_path, sent[0])
    for message in sent[:-1]:
        writer.write(message)
    writer.ledger = type(writer.ledger)()
    writer.write(frame("e", 3)[0])
    writer.write(image("e", 4).model_copy(update={"data": b"no image", "tick": 9}))
    (one,) = [writer.seal()]
    status, told, _ = smal("recording", "verify", one)
    assert status == 1
    assert told.splitlines() == [
        f"{one}: episode e: camera/jpeg: 1 of 6 cannot be decoded: tick 9: not a JPEG image",
        f"{one}: episode e: pose/truth: 1 duplicates, the first at tick 3",
        f"{one}: episode e: end not recorded",
        f"{one}: episode e: camera/jpeg lacks 2",
    ]


def seconds_of(path: Path) -> list[tuple[int, int, int]]:
    """Return where the chunks of a recording begin and end, and how many messages of ours are in each."""
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    own = {number for number, channel in summary.channels.items() if not is_view(channel.topic)}
    found = []
    for one in summary.chunk_indexes:
        end = one.chunk_start_offset + one.chunk_length + one.message_index_length
        stored = stored_in(path, log_time_order=False)
        times = range(one.message_start_time, one.message_end_time + 1)
        count = (
            sum(message.log_time in times for _, message in stored)
            if one.message_index_offsets.keys() & own
            else 0
        )
        found.append((one.chunk_start_offset, end, count))
    return found


@pytest.mark.parametrize("hole", [1, 4096])
def test_repair_loses_only_the_damaged_seconds(tmp_path: Path, hole: int) -> None:
    path = record(tmp_path, list(episode("e", frames=35)))
    content = path.read_bytes()
    whole = read_all(path)
    seconds = seconds_of(path)
    bad = tmp_path / "bad.mcap"
    out = tmp_path / "out.mcap"
    for at in range(8, len(content) - hole, 28_001):
        instead = bytes([content[at] ^ 0x10]) if hole == 1 else bytes(hole)
        bad.write_bytes(content[:at] + instead + content[at + hole :])
        assert verify(bad).damage, f"byte {at} of {len(content)}"
        saved = read_all(mended(bad, out))
        assert set(saved) <= set(whole)
        assert len(saved) >= len(whole) - sum(
            n for begin, end, n in seconds if begin < at + hole and at < end
        )
        out.unlink()


def test_repair_overwrites_only_when_forced(tmp_path: Path, smal: Smal) -> None:
    sent = list(episode("e", frames=24))
    partial = leave(tmp_path, sent)
    other = tmp_path / "e.mcap"
    before = partial.read_bytes()
    other.write_bytes(b"another")
    status, _, why = smal("recording", "repair", partial, "--out", other)
    assert (status, why) == (
        2,
        f"smal: --out {other}: already exists; choose another name, or give --replace\n",
    )
    with pytest.raises(JobError, match="already exists"):
        repair([partial], other)
    path = usual_name(partial, replace=False)
    assert path == tmp_path / "e-2.mcap"
    assert mended(partial, path) == path
    assert sorted(read_all(path)) == wanted(sent)
    assert partial.read_bytes() == before
    _, after = repair([partial], path, replace=True)
    assert (after.findings, read_all(path)) == ([], read_all(path))
    assert not partial.exists()
    assert other.read_bytes() == b"another"
    content = path.read_bytes()
    path.write_bytes(content[:-200])
    assert usual_name(path, replace=False) == tmp_path / "e-2-repaired.mcap"
    repair([path], usual_name(path, replace=True), replace=True)
    assert len(read_all(path)) == len(sent)
    assert repair([path], path)[1] is None, "no repair needed"


def test_two_episodes_are_not_made_one(tmp_path: Path) -> None:
    two = [record(tmp_path, list(episode(name))) for name in ("e", "other")]
    with pytest.raises(JobError, match="episode other differs"):
        repair(two, tmp_path / "both.mcap")


def test_repair_rejects_open_and_empty_recordings(tmp_path: Path) -> None:
    writer = EpisodeWriter.begin(tmp_path, event("e", 0, "started"))
    writer.write(event("e", 0, "started"))
    writer.flush()
    living = partial_of(writer.path)
    assert contents_of(living).state == "being recorded"
    with pytest.raises(JobError, match="still being recorded"):
        repair([living], tmp_path / "out.mcap")
    writer.write(applied("e", 0))
    writer.seal()
    for content, why in ((b"", "empty"), (b"no", "not an MCAP file")):
        (tmp_path / "bad.mcap").write_bytes(content)
        with pytest.raises(RecordingError, match=why):
            repair([tmp_path / "bad.mcap"], tmp_path / "out.mcap")
    (tmp_path / "bad.mcap").write_bytes(writer.path.read_bytes()[:60])
    with pytest.raises(JobError, match="no messages of an episode to save"):
        repair([tmp_path / "bad.mcap"], tmp_path / "out.mcap")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["bad.mcap", "e.mcap"]

"""The recorder on a real router: good, malformed and missing messages, and every way to end."""

import errno
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import pytest

from schemas.base import Message
from schemas.rpc import Nothing, RecordReply, RecordRequest
from services.kit.bus import Bus, RpcError
from services.kit.node import Node, ServiceError
from services.kit.settings import ServiceSettings
from services.recorder.disk import LEAST_BYTES, Disk
from services.recorder.service import GRACE_S, RecorderService
from services.recordings.contents import contents_of, verify
from services.recordings.reader import read_recording
from services.recordings.repair import repair
from services.recordings.sink import partial_of
from tests.services.recordings.recorded_messages import (
    applied,
    episode,
    event,
    frame,
    image,
    state,
)
from tests.services.recordings.test_recorder_files import FullDisk, leave, read_all, wanted
from tests.services.waiting import eventually, introduce, ready, status_of

RunNode = Callable[[Node], Node]


def introductions() -> list[Message]:
    """One message for every topic, of an episode that never starts."""
    return [*frame("nobody", 0), applied("nobody", 0), event("nobody", 0, "ended", "aborted")]


def publish(bus: Bus, messages: list[Message]) -> None:
    for message in messages:
        bus.publish(message)


def received(bus: Bus) -> int:
    status = status_of(bus, "recorder")
    return sum(status.received.values()) if status else 0


def send(bus: Bus, messages: list[Message]) -> None:
    """Publish, and wait until all of it was taken: the two sessions of a robot would else race each other."""
    for message in messages:
        before = received(bus)
        bus.publish(message)
        eventually(lambda before=before: received(bus) > before)


def contents(path: Path) -> list[tuple[str, int, bytes]]:
    """Return every message of a recording, sorted: the order between topics is nobody's promise."""
    return sorted(read_all(path))


def sealed(bus: Bus, count: int) -> bool:
    status = status_of(bus, "recorder")
    return (
        status is not None
        and status.detail["files"] == count
        and status.detail["recording"] is None
    )


@pytest.fixture
def recorder(
    settings: ServiceSettings, run_node: RunNode, client: Bus, tmp_path: Path
) -> Iterator[RecorderService]:
    node = Node("recorder", settings)
    service = RecorderService(node, tmp_path, tmp_path)
    run_node(node)
    introduce(client, "recorder", *introductions())
    return service


def stop(bus: Bus) -> RecordReply:
    return bus.call("recorder", "stop", Nothing(), RecordReply)


def test_one_file_an_episode_with_every_message(
    recorder: RecorderService, client: Bus, tmp_path: Path
) -> None:
    sent = list(episode("drive-1")), list(episode("drive-2", frames=3))
    for messages in sent:
        publish(client, messages[:1])
        eventually(lambda: ready(client, "recorder").detail["recording"] is not None)
        silent_s = ready(client, "recorder").uptime_s + GRACE_S + 0.2
        eventually(lambda until=silent_s: ready(client, "recorder").uptime_s > until)
        publish(client, messages[1:])
        eventually((tmp_path / f"{messages[0].episode}.mcap").exists)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["drive-1.mcap", "drive-2.mcap"]
    for messages, name in zip(sent, ("drive-1", "drive-2"), strict=True):
        assert contents(tmp_path / f"{name}.mcap") == wanted(messages)
    send(
        client,
        [event("third", 0, "started"), *frame("third", 0), event("third", 0, "ended", "found")],
    )
    reply = client.call("recorder", "flush", Nothing(), RecordReply)
    assert (reply.files, reply.dropped) == (("drive-1.mcap", "drive-2.mcap", "third.mcap"), 0)
    assert ready(client, "recorder").detail["duplicates"] == 0


def test_messages_are_kept_before_start_and_after_end(
    recorder: RecorderService, client: Bus, tmp_path: Path
) -> None:
    start, *most, end = list(episode("drive-1"))
    early = applied("drive-1", 0)
    late = state("drive-1", 4)
    send(client, [early, start, *(message for message in most if message not in (early, late))])
    send(client, [end, event("drive-2", 0, "started"), late])
    eventually((tmp_path / "drive-1.mcap").exists)
    assert contents(tmp_path / "drive-1.mcap") == wanted([start, *most, end])
    assert partial_of(tmp_path / "drive-2.mcap").exists()


def test_recorder_is_idle_before_start_and_after_stop(
    settings: ServiceSettings, run_node: RunNode, client: Bus, tmp_path: Path
) -> None:
    node = Node("recorder", settings)
    RecorderService(node, tmp_path)
    run_node(node)
    introduce(client, "recorder", *introductions())
    send(client, list(episode("before", frames=1)))
    folder = tmp_path / "new" / "folder"
    client.call("recorder", "start", RecordRequest(folder="new/folder"), Nothing)
    publish(client, list(episode("during", frames=2)))
    eventually(lambda: sealed(client, 1))
    send(client, [event("cut", 0, "started"), *frame("cut", 0)])
    reply = stop(client)
    assert list(reply.files) == ["during.mcap", "cut.mcap"]
    send(client, list(episode("after", frames=1)))
    assert sorted(path.name for path in folder.iterdir()) == ["cut.mcap", "during.mcap"]
    assert read_recording(folder / "cut.mcap").episodes[0].outcome is None


def test_a_folder_that_cannot_be_is_refused_in_one_line(
    recorder: RecorderService, client: Bus, tmp_path: Path, settings: ServiceSettings
) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(
        RpcError,
        match=r"^recorder start: cannot record in 'file/folder' below the root of the recorder$",
    ):
        client.call("recorder", "start", RecordRequest(folder="file/folder"), Nothing)
    with Node("other", settings) as node, pytest.raises(ServiceError, match="Not a directory"):
        RecorderService(node, tmp_path, tmp_path / "file" / "folder")
    publish(client, list(episode("on")))
    eventually(lambda: sealed(client, 1))


def no_space(*_: object) -> None:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_a_full_disk_ends_the_file_and_not_the_recorder(
    recorder: RecorderService, client: Bus, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("services.recordings.writer.Sink", FullDisk)
    sent = list(episode("full", frames=40))
    publish(client, sent)
    eventually(lambda: sealed(client, 1))
    detail = ready(client, "recorder").detail
    assert "cannot seal" in str(detail["last_error"])
    assert "No space left on device" in str(detail["last_error"])
    assert partial_of(tmp_path / "full.mcap").exists()
    monkeypatch.undo()
    publish(client, list(episode("room")))
    eventually(lambda: sealed(client, 2))
    assert contents(tmp_path / "room.mcap") == wanted(list(episode("room")))
    written = len(read_all(tmp_path / "full.mcap"))
    assert written > 10
    reply = stop(client)
    assert reply.files == ("full.mcap", "room.mcap")
    assert written + reply.dropped == len(sent)


@pytest.fixture
def process(router_endpoint: str, tmp_path: Path) -> Iterator[subprocess.Popen[str]]:
    command = [
        sys.executable, "-m", "services.recorder", "--router", router_endpoint, "--recordings",
        str(tmp_path),
    ]  # fmt: skip
    child = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    yield child
    child.kill()
    child.communicate()


@pytest.mark.zenoh
def test_sigterm_finishes_the_running_recording(
    process: subprocess.Popen[str], client: Bus, tmp_path: Path
) -> None:
    introduce(client, "recorder", *introductions())
    send(client, [event("cut", 0, "started"), *frame("cut", 0)])
    process.send_signal(signal.SIGTERM)
    assert process.wait(100.0) == 0
    assert "Traceback" not in process.stderr.read()
    recording = read_recording(tmp_path / "cut.mcap")
    assert not recording.truncated
    assert len(read_all(tmp_path / "cut.mcap")) == 1 + len(frame("cut", 0))


def test_recorder_awaits_messages_when_cut_episode_has_ended(
    settings: ServiceSettings,
    run_node: RunNode,
    client: Bus,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """On a busy machine the files were named before messages were sent again."""
    monkeypatch.setattr("services.recorder.service.EARLY_S", 2.0)
    sent = list(episode("cut", frames=20))
    leave(tmp_path, sent[:30])
    node = Node("recorder", settings)
    RecorderService(node, tmp_path, tmp_path)
    run_node(node)
    introduce(client, "recorder", *introductions())
    again = threading.Timer(0.5, publish, (client, sent))
    again.start()
    reply = client.call("recorder", "flush", Nothing(), RecordReply, timeout_s=100.0)
    again.join()
    assert list(reply.files) == ["cut-2.mcap"]
    assert contents(tmp_path / "cut-2.mcap") == wanted(sent)


@pytest.mark.zenoh
def test_recorder_keeps_all_messages_when_killed_and_restarted(
    request: pytest.FixtureRequest, process: subprocess.Popen[str], client: Bus, tmp_path: Path
) -> None:
    introduce(client, "recorder", *introductions())
    before = list(episode("before", frames=3))
    killed = list(episode("killed", frames=40))
    publish(client, before)
    eventually(lambda: sealed(client, 1))
    publish(client, killed[:50])
    eventually(lambda: ready(client, "recorder").detail["messages"] == len(before) + 50)
    process.kill()
    process.wait(100.0)
    publish(client, killed[50:-1])
    command = [*process.args[:-1], str(tmp_path)]
    again = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    request.addfinalizer(again.kill)
    # What was said while nobody recorded, and what was not written yet, is fetched from who said it.
    eventually(lambda: ready(client, "recorder").detail["messages"] == len(killed) - 1)
    publish(client, killed[-1:])
    eventually((tmp_path / "killed-2.mcap").exists)
    again.send_signal(signal.SIGTERM)
    _, log = again.communicate(timeout=100.0)
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "before.mcap",
        "killed-2.mcap",
        "killed.mcap",
    ]
    assert f"sealed {tmp_path}/killed.mcap, left by a killed recorder" in log
    assert contents(tmp_path / "before.mcap") == wanted(before)
    assert contents(tmp_path / "killed.mcap") == wanted(killed[:50])
    assert contents(tmp_path / "killed-2.mcap") == wanted(killed)
    repair([tmp_path / "killed.mcap", tmp_path / "killed-2.mcap"], tmp_path / "whole.mcap")
    assert contents(tmp_path / "whole.mcap") == wanted(killed)
    assert verify(tmp_path / "whole.mcap").findings == []


def test_recording_goes_on_when_the_recorder_is_restarted(
    settings: ServiceSettings, tmp_path: Path
) -> None:
    sent = list(episode("e", frames=4))
    over = list(episode("over", frames=2))
    for messages in ((*over, *sent[:20]), (*over, *sent)):
        with Node("recorder", settings) as node:
            recorder = RecorderService(node, tmp_path, tmp_path)
            for message in messages:
                recorder.handle(message)
            recorder.close()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["e-2.mcap", "e.mcap", "over.mcap"]
    assert contents(tmp_path / "e.mcap") == wanted(sent[:20])
    assert contents(tmp_path / "e-2.mcap") == wanted(sent)


IMAGE = 100_000  # Bytes of the image that a robot sends in a second.


class Room:
    """A disk that fills as time goes by, and a clock."""

    def __init__(self, free: int) -> None:
        self.now_s = 0.0
        self.free = free

    def disk(self) -> Disk:
        return Disk(lambda: self.now_s, lambda _: self.free)

    def drive(self, recorder: RecorderService, ticks: Iterable[int]) -> None:
        """Drive, with an image a second, which takes its bytes from the disk."""
        for tick in ticks:
            data = image("e", tick).data + bytes(IMAGE)
            recorder.handle(image("e", tick).model_copy(update={"data": data}))
            self.now_s = self.now_s + 1.0
            self.free = self.free - IMAGE
            recorder.look_after_files()


def test_drive_is_sealed_before_the_disk_is_full(
    settings: ServiceSettings, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    room = Room(LEAST_BYTES + 700 * IMAGE)
    with Node("recorder", settings) as node:
        recorder = RecorderService(node, tmp_path, tmp_path, lambda: room.now_s, room.disk())
        recorder.handle(event("e", 0, "started"))
        room.drive(recorder, range(10))
        assert recorder.detail()["disk"] is None, "690 seconds are left"
        room.free -= 120 * IMAGE
        room.drive(recorder, range(10, 20))
        assert recorder.detail()["disk"] == "disk almost full: space for 9 minutes of recording"
        room.free -= 500 * IMAGE
        room.drive(recorder, range(20, 26))
        assert recorder.detail()["disk"] == "disk almost full: space for 50 seconds of recording"
        room.drive(recorder, range(26, 90))
        detail = recorder.detail()
        assert str(detail["disk"]).startswith("disk full (")
        assert str(detail["last_error"]) == f"{detail['disk']}; earlier messages are sealed"
        whole = contents_of(tmp_path / "e.mcap")
        assert (whole.state, whole.damage) == ("sealed", [])
        assert whole.episodes[0].frames + int(str(detail["lost"])) == 90
        assert whole.episodes[0].frames > 65
        room.free = LEAST_BYTES - 1
        recorder.handle(event("next", 0, "started"))
        assert str(recorder.detail()["last_error"]).startswith(
            "cannot record episode next: disk full"
        )
        room.free = 2 * LEAST_BYTES
        recorder.handle(event("last", 0, "started"))
        recorder.look_after_files()
        assert recorder.detail()["disk"] is None
        with monkeypatch.context() as full:
            full.setattr("services.recordings.sink.Sink.write", no_space)
            recorder.handle(image("last", 0))
            recorder.look_after_files()
        assert recorder.detail()["disk"] == "No space left on device: recording stopped"
        monkeypatch.setattr("services.recorder.service._SETTLE_S", 0.0)  # its clock stands still
        recorder.stop(Nothing())
        recorder.close()
    assert (tmp_path / "last.mcap").exists()
    assert not (tmp_path / "next.mcap").exists()


def test_an_episode_that_never_ends_is_closed_by_the_next(
    recorder: RecorderService, client: Bus, tmp_path: Path
) -> None:
    send(client, [event("lost", 0, "started"), *frame("lost", 0)])
    publish(client, list(episode("next")))
    eventually(lambda: sealed(client, 2))
    assert read_recording(tmp_path / "lost.mcap").episodes[0].end_tick is None
    assert len(read_all(tmp_path / "next.mcap")) == len(list(episode("next")))

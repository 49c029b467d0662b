"""The recorder runs for as long as a command needs it, and is stopped also where the command fails."""

from pathlib import Path

import pytest
from pydantic import ValidationError

from schemas.rpc import Nothing, RecordReply, RecordRequest
from services.cli.episodes.files import recording
from services.kit.bus import Bus, RpcError
from services.kit.errors import UsageError
from services.kit.node import Node, ServiceError
from services.kit.settings import ServiceSettings
from services.recorder.disk import Disk
from services.recorder.service import RecorderService
from tests.services.conftest import RunNode
from tests.services.recordings.recorded_messages import event, image
from tests.services.waiting import eventually, introduce, ready


class FakeRecorder:
    """Notes what it is told; refuses one verb if asked to."""

    def __init__(self, node: Node, root: Path) -> None:
        self.told: list[str] = []
        self.refuses: str | None = None
        self.dropped = 0
        node.detail = lambda: {"root": str(root)}
        node.serve("start", RecordRequest, self.start)
        node.serve("stop", Nothing, self.stop)

    def start(self, request: RecordRequest) -> None:
        self._tell(f"start {request.folder}")

    def stop(self, _request: Nothing) -> RecordReply:
        self._tell("stop")
        return RecordReply(files=("a.mcap", "b.mcap"), dropped=self.dropped)

    def _tell(self, verb: str) -> None:
        self.told.append(verb)
        if self.refuses is not None and verb.startswith(self.refuses):
            raise ServiceError("no disk")


@pytest.fixture
def recorder(settings: ServiceSettings, run_node: RunNode, tmp_path: Path) -> FakeRecorder:
    node = Node("recorder", settings)
    fake = FakeRecorder(node, tmp_path)
    run_node(node)
    return fake


def test_files_and_lost_messages_are_known_at_the_end(
    recorder: FakeRecorder, client: Bus, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recorder.dropped = 7
    with recording(client, tmp_path / "drives", "--out") as recorded:
        assert recorder.told == ["start drives"]
    assert recorder.told[1:] == ["stop"]
    assert recorded == ["a.mcap", "b.mcap"]
    assert "warning: the recorder dropped 7 messages" in capsys.readouterr().out


@pytest.mark.parametrize("failure", [ValueError("sic"), KeyboardInterrupt("sic")], ids=repr)
@pytest.mark.parametrize("refuses", [None, "stop"])
def test_recorder_is_stopped_when_an_episode_fails(
    recorder: FakeRecorder, client: Bus, tmp_path: Path, failure: BaseException, refuses: str | None
) -> None:
    recorder.refuses = refuses
    with pytest.raises(type(failure), match="sic"), recording(client, tmp_path / "drives", "--out"):
        raise failure
    assert recorder.told[1:] == ["stop"]


def test_a_recorder_that_refuses_the_folder_goes_on_with_its_own(
    recorder: FakeRecorder, client: Bus, tmp_path: Path
) -> None:
    recorder.refuses = "start"
    with (
        pytest.raises(RpcError, match="recorder start: no disk"),
        recording(client, tmp_path / "drives", "--out"),
    ):
        pytest.fail("nothing is recorded")
    assert recorder.told == ["start drives"]


def test_record_reports_folder_when_recorder_writes_elsewhere(
    recorder: FakeRecorder, client: Bus, tmp_path: Path
) -> None:
    link = tmp_path / "link"
    link.symlink_to(tmp_path.parent)
    for folder in (tmp_path.parent, link, Path("/")):
        with pytest.raises(UsageError) as caught, recording(client, folder, "--out"):
            pytest.fail("nothing is recorded")
        assert str(caught.value) == (
            f"--out {folder}: outside the folder of the recorder, {tmp_path}; move it there, or start "
            "the stack with --root"
        )
    with (
        pytest.raises(ValidationError, match="no part may begin with a dot"),
        recording(client, tmp_path / ".x", "--out"),
    ):
        pytest.fail("nothing is recorded")
    assert recorder.told == []
    with recording(client, tmp_path, "--out"):
        assert recorder.told == ["start "]


def test_command_reports_cause_when_recording_is_empty(
    settings: ServiceSettings,
    run_node: RunNode,
    client: Bus,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    node = Node("recorder", settings)
    RecorderService(node, tmp_path, disk=Disk(lambda: 0.0, lambda _: 0))
    run_node(node)
    introduce(client, "recorder", event("nobody", 0, "ended", "aborted"), image("nobody", 0))
    with recording(client, tmp_path / "runs", "--record") as files:
        client.publish(event("e", 0, "started"))
        eventually(lambda: ready(client, "recorder").detail["recording"])
        client.publish(image("e", 0))
        eventually(lambda: ready(client, "recorder").detail["lost"])
    assert files == []
    assert "messages (cannot record episode e: disk full (0 MB free); recording stopped)" in (
        capsys.readouterr().out
    )

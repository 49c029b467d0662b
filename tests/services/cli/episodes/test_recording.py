"""The recorder runs for as long as a command needs it, and is stopped also where the command fails."""

from __future__ import annotations

from pathlib import Path

import pytest

from schemas.rpc import Nothing, RecordReply, RecordRequest
from services.cli.episodes.recording import recording
from services.kit.bus import Bus, RpcError
from services.kit.node import Node, ServiceError
from services.kit.settings import ServiceSettings
from tests.services.conftest import RunNode


class FakeRecorder:
    """Notes what it is told; refuses one verb if asked to."""

    def __init__(self, node: Node) -> None:
        self.told: list[str] = []
        self.refuses: str | None = None
        self.dropped = 0
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
def recorder(settings: ServiceSettings, run_node: RunNode) -> FakeRecorder:
    node = Node("recorder", settings)
    fake = FakeRecorder(node)
    run_node(node)
    return fake


def test_files_are_known_at_the_end(
    recorder: FakeRecorder, client: Bus, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with recording(client, tmp_path) as recorded:
        assert recorder.told == [f"start {tmp_path}"]
    assert recorder.told[1:] == ["stop"]
    assert recorded.files == ("a.mcap", "b.mcap")
    assert capsys.readouterr().out == ""


def test_lost_messages_are_told(
    recorder: FakeRecorder, client: Bus, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recorder.dropped = 7
    with recording(client, tmp_path):
        pass
    assert "warning: the recorder dropped 7 messages" in capsys.readouterr().out


@pytest.mark.parametrize("failure", [ValueError("sic"), KeyboardInterrupt("sic")], ids=repr)
@pytest.mark.parametrize("refuses", [None, "stop"])
def test_recorder_is_stopped_after_a_failure_which_remains_the_news(
    recorder: FakeRecorder, client: Bus, tmp_path: Path, failure: BaseException, refuses: str | None
) -> None:
    recorder.refuses = refuses
    with pytest.raises(type(failure), match="sic"), recording(client, tmp_path):
        raise failure
    assert recorder.told[1:] == ["stop"]


def test_a_recorder_that_refuses_the_folder_goes_on_with_its_own(
    recorder: FakeRecorder, client: Bus, tmp_path: Path
) -> None:
    recorder.refuses = "start"
    with pytest.raises(RpcError, match="recorder start: no disk"), recording(client, tmp_path):
        pytest.fail("nothing is recorded")
    assert recorder.told == [f"start {tmp_path}"]


def test_files_that_cannot_be_finished_are_an_error(recorder: FakeRecorder, client: Bus, tmp_path: Path) -> None:
    recorder.refuses = "stop"
    with pytest.raises(RpcError, match="recorder stop: no disk"), recording(client, tmp_path):
        pass

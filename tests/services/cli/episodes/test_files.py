"""What a command reports of the recorder that records for it."""

from pathlib import Path

import pytest

from services.cli.episodes.files import recording
from services.kit.bus import Bus
from services.kit.node import Node
from services.kit.settings import ServiceSettings
from services.recorder.disk import Disk
from services.recorder.service import RecorderService
from tests.services.conftest import RunNode
from tests.services.recordings.recorded_messages import event, image
from tests.services.waiting import eventually, introduce, ready


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

"""A name in a request is a regular file below the root, or an error of one line."""

import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from schemas.rpc import LoadReply, LoadRequest, Nothing, RecordReply, RecordRequest, Status
from services.kit.bus import Bus, RpcError
from services.kit.model_service import serve_loads
from services.kit.node import Node
from services.kit.root import RootSettings
from services.kit.settings import ServiceSettings
from services.policy.service import PolicyService
from services.recognition.service import RecognitionService
from services.recorder.service import RecorderService
from smal.files import container
from tests.services.chain import LENGTH, save_model
from tests.services.conftest import RunNode
from tests.services.recordings.recorded_messages import applied, episode, event
from tests.services.waiting import DEADLINE_S, eventually, introduce, ready

#: No name at all: the request itself is malformed.
MALFORMED = ("/etc/passwd", "..", "../other.smal", "a/../../other.smal", ".", "./a", ".ssh/id", "a//b", "a/", "a\\b",
             "a\0b", "a\nb", "", "x" * 2000)  # fmt: skip


@pytest.fixture
def root(tmp_path: Path) -> Path:
    made = tmp_path / "root"
    made.mkdir()
    return made


@pytest.fixture
def service(settings: ServiceSettings, run_node: RunNode, root: Path) -> str:
    """Give the name of a service that works with a model below a root."""
    node = Node("policy", settings)
    serve_loads(node, PolicyService(), root)
    run_node(node)
    return "policy"


def refusal(call: Callable[[], object]) -> str:
    """Return the line with which a running service refuses a call."""
    with pytest.raises(RpcError) as caught:
        call()
    line = str(caught.value)
    assert line.isprintable()
    return line.split(": ", 1)[1]


def load(bus: Bus, service: str, name: str) -> LoadReply:
    # As anybody may send it, whatever our own classes say.
    request = LoadRequest.model_construct(model=name, scheme=None, stride=None, goal=None)
    return bus.call(service, "load", request, LoadReply, timeout_s=DEADLINE_S)


def forbid(path: Path) -> None:
    path.write_bytes(b"")
    path.chmod(0)


def outside(path: Path) -> Path:
    return save_model(path.parents[1] / "outside.smal")


def sparse(path: Path) -> None:
    with path.open("wb") as file:
        file.write(container.MAGIC)
        file.truncate(container.LARGEST + 1)


NOTHING = {
    "missing": lambda path: None,
    "folder": Path.mkdir,
    "fifo": os.mkfifo,
    "link out": lambda path: path.symlink_to(outside(path)),
    "relative link out": lambda path: path.symlink_to(Path("..") / outside(path).name),
    "link to a device": lambda path: path.symlink_to("/dev/zero"),
    "loop of links": lambda path: path.symlink_to(path),
    "dangling link": lambda path: path.symlink_to(path.with_name("none")),
    "no rights": forbid,
    "too large": sparse,
    "no model": lambda path: path.write_text("root:x:0:0:root:/root:/bin/bash\n"),
    "empty": Path.touch,
}


def test_file_that_is_no_model_looks_missing(service: str, root: Path, client: Bus) -> None:
    save_model(root / "good.smal")
    load(client, service, "good.smal")
    before = client.call(service, "status", Nothing(), Status).detail
    for number, (kind, make) in enumerate(NOTHING.items()):
        make(root / f"{number}.smal")
        line = refusal(lambda number=number: load(client, service, f"{number}.smal"))
        assert line == f"model '{number}.smal' not found below the root of this service", kind
        assert client.call(service, "status", Nothing(), Status).detail == before, kind
    assert (before["model"], before["root"]) == ("good.smal", str(root))


def test_a_link_of_a_folder_leads_out_no_more_than_one_of_a_file(
    service: str, root: Path, client: Bus
) -> None:
    save_model(root.parent / "outside.smal")
    (root / "up").symlink_to("..")
    (root / "inside").symlink_to(".")
    line = refusal(lambda: load(client, service, "up/outside.smal"))
    assert line == "model 'up/outside.smal' not found below the root of this service"
    save_model(root / "good.smal")
    assert load(client, service, "inside/good.smal").stride == LENGTH


def test_device_is_not_a_model(settings: ServiceSettings, run_node: RunNode, client: Bus) -> None:
    node = Node("recognition", settings)
    serve_loads(node, RecognitionService(), Path("/dev"))
    run_node(node)
    for device in ("zero", "null", "tty", "fd/0"):
        line = refusal(lambda device=device: load(client, "recognition", device))
        assert line == f"model '{device}' not found below the root of this service"


def test_malformed_name_is_refused_before_any_lookup(service: str, client: Bus) -> None:
    lines = {refusal(lambda name=name: load(client, service, name)) for name in MALFORMED}
    assert lines == {
        "model: must be a relative path below the root of the service; no part may begin with a dot",
        f"model: '{'x' * 40}' must have at most 1023 characters",
        "model: '' must have at least 1 character",
    }


def test_the_root_is_the_folder_of_the_start_unless_it_is_set(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, root: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    assert RootSettings().root == tmp_path
    monkeypatch.setenv("SMAL_ROOT", "root")
    assert RootSettings().root == root
    monkeypatch.setenv("SMAL_ROOT", "none")
    with pytest.raises(ValueError, match="none: folder not found"):
        RootSettings()


@pytest.fixture
def recorder(settings: ServiceSettings, run_node: RunNode, client: Bus, root: Path) -> None:
    node = Node("recorder", settings)
    RecorderService(node, root, root / "drives")
    run_node(node)
    introduce(client, "recorder", *episode("nobody", frames=1), applied("nobody", 0))


def start(bus: Bus, name: str) -> None:
    bus.call(
        "recorder",
        "start",
        RecordRequest.model_construct(folder=name),
        Nothing,
        timeout_s=DEADLINE_S,
    )


def files(folder: Path) -> list[str]:
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if not path.is_dir())


@pytest.mark.usefixtures("recorder")
def test_recorder_writes_only_below_its_root(client: Bus, root: Path) -> None:
    elsewhere = root.parent / "elsewhere"
    elsewhere.mkdir()
    (root / "out").symlink_to(elsewhere)
    (root / "dangling").symlink_to(elsewhere / "new")
    (root / "up").symlink_to("..")
    (root / "null").symlink_to("/dev/null")
    (root / "loop").symlink_to("loop")
    (root / "file").touch()
    os.mkfifo(root / "fifo")
    for name in (
        "out", "out/deeper", "dangling", "up/elsewhere", "null", "null/x", "loop", "file", "file/x",
        "fifo",
    ):  # fmt: skip
        line = refusal(lambda name=name: start(client, name))
        assert line == f"cannot record in '{name}' below the root of the recorder"
    lines = {
        refusal(lambda name=name: start(client, name)).partition(":")[0]
        for name in MALFORMED
        if name
    }
    assert lines == {"folder"}
    assert files(elsewhere) == []
    assert sorted(path.name for path in root.parent.iterdir()) == ["elsewhere", "root"]
    # It goes on with the folder that it had.
    for message in episode("on", frames=2):
        client.publish(message)
    eventually((root / "drives" / "on.mcap").exists)


@pytest.mark.usefixtures("recorder")
def test_the_recorder_s_root_itself_can_be_named(client: Bus, root: Path) -> None:
    start(client, "")
    assert ready(client, "recorder").detail["folder"] == str(root)
    for message in episode("here", frames=2):
        client.publish(message)
    eventually((root / "here.mcap").exists)
    assert client.call("recorder", "stop", Nothing(), RecordReply).files == ("here.mcap",)


@pytest.mark.usefixtures("recorder")
def test_planted_files_do_not_lead_the_recorder_out(client: Bus, root: Path) -> None:
    folder = root / "trap"
    folder.mkdir()
    precious = root.parent / "precious.mcap.partial"
    precious.write_bytes(b"")
    os.mkfifo(folder / "fifo.mcap.partial")
    (folder / "zero.mcap.partial").symlink_to("/dev/zero")
    (folder / "link.mcap.partial").symlink_to(precious)
    (folder / "e.mcap").symlink_to(root.parent / "e.mcap")
    start(client, "trap")
    client.publish(event("e", 0, "started"))
    for message in list(episode("e", frames=2))[1:]:
        client.publish(message)
    eventually(
        lambda: any(path.is_file() and not path.is_symlink() for path in folder.glob("e*.mcap"))
    )
    shutil.rmtree(folder)
    assert sorted(path.name for path in root.parent.iterdir()) == ["precious.mcap.partial", "root"]
    assert precious.read_bytes() == b""

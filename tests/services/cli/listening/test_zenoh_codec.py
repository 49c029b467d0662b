"""The codec for zenoh-cli: alone, and inside the real ``zenoh`` command against a real router."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tomllib
from collections.abc import Callable, Iterator
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path

import pytest
from hypothesis import given, settings

from schemas.base import Message
from schemas.codec import encode
from schemas.command import Command
from schemas.compressed_image import CompressedImage
from schemas.topics import STATE, key_of
from services.cli.listening.zenoh_codec import decode_to_json
from services.kit.bus import Bus
from tests.schemas.messages import EXAMPLES, any_message
from tests.services.waiting import eventually, send_as_stranger

ROOT = Path(__file__).parents[4]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
GROUPS = {name: PROJECT["entry-points"][name] for name in ("zenoh_cli.codecs.decoders",)}
TELEOP = "smal/rescuebot/command/teleop"


# -- alone ------------------------------------------------------------------------------------------------------------


@given(any_message)
@settings(max_examples=25)
def test_a_message_is_a_line_with_all_its_fields(message: Message) -> None:
    line = decode_to_json(key_of(message), encode(message))
    assert line.isprintable()
    assert set(json.loads(line)) == set(type(message).model_fields)


@pytest.mark.parametrize(
    ("key", "payload", "reason"),
    [
        ("other/key", b"x", "no topic of SMAL"),
        (TELEOP, b"\xc1", "not msgpack"),
        (TELEOP, b"", "not msgpack"),
        (TELEOP, encode(EXAMPLES[CompressedImage]), "at most|Field required"),
        ("smal/stranger/command/teleop", encode(EXAMPLES[Command]), "holds a message of rescuebot/command/teleop"),
        ("smal/rescuebot/rpc/robot/status", b"\xff", "not JSON"),
        ("smal/rescuebot/rpc/robot/status", b"[" * 100_000, "not JSON"),
    ],
)
def test_a_bad_payload_is_an_error_object(key: str, payload: bytes, reason: str) -> None:
    found = json.loads(decode_to_json(key, payload))
    assert set(found) == {"error", "bytes"}
    assert found["bytes"] == len(payload)
    assert any(part in found["error"] for part in reason.split("|"))


# -- inside zenoh-cli -------------------------------------------------------------------------------------------------

Zenoh = Callable[..., subprocess.Popen[str]]
needs_zenoh_cli = pytest.mark.skipif(find_spec("zenoh_cli") is None, reason="zenoh-cli is not installed")


@pytest.fixture
def zenoh(router_endpoint: str, tmp_path: Path) -> Iterator[Zenoh]:
    """Run the ``zenoh`` command; it finds the codec as that of an installed package, which this one may not be."""
    package = tmp_path / "smal_codec-0.dist-info"
    package.mkdir()
    (package / "METADATA").write_text("Metadata-Version: 2.1\nName: smal-codec\nVersion: 0\n")
    groups = (f"[{group}]\n" + "".join(f"{n} = {v}\n" for n, v in plugins.items()) for group, plugins in GROUPS.items())
    (package / "entry_points.txt").write_text("".join(groups))
    started: list[subprocess.Popen[str]] = []

    def run(*arguments: str) -> subprocess.Popen[str]:
        where = ("--mode", "client", "--connect", router_endpoint, "--cfg", "scouting/multicast/enabled:false")
        child = subprocess.Popen(
            [sys.executable, "-m", "zenoh_cli", *where, *arguments],
            env=os.environ | {"PYTHONPATH": os.pathsep.join([str(tmp_path), str(ROOT)])},
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        started.append(child)
        return child

    yield run
    for child in started:
        child.kill()
        child.communicate()


@pytest.mark.zenoh
@needs_zenoh_cli
def test_zenoh_subscribe_shows_decoded_messages(zenoh: Zenoh, client: Bus) -> None:
    listener = zenoh("subscribe", "-k", "smal/**", "--decoder", "smal", "--line", "{key} {value}")
    assert listener.stdout is not None
    os.set_blocking(listener.stdout.fileno(), False)
    said = bytearray()

    def heard() -> bool:
        client.publish(EXAMPLES[Command])
        client.publish(EXAMPLES[CompressedImage])
        send_as_stranger(client, STATE, b"\xc1")
        with suppress(BlockingIOError):
            said.extend(os.read(listener.stdout.fileno(), 1 << 20))
        return len(lines()) == 3

    def lines() -> dict[str, str]:
        """Give the last whole line of each key."""
        return dict(line.split(" ", 1) for line in said.decode().split("\n")[:-1])

    eventually(heard)
    assert json.loads(lines()[TELEOP]) == EXAMPLES[Command].model_dump()
    assert json.loads(lines()["smal/rescuebot/camera/jpeg"])["data"] == {"bytes": 4}
    assert "not msgpack" in json.loads(lines()["smal/rescuebot/state"])["error"]

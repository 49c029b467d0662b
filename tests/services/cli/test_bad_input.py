"""Whatever a user gets wrong is told in one line that names it, with the promised exit status."""

from __future__ import annotations

import socket
import struct
import sys
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import pytest

from services.cli.main import main
from services.kit.process import EXIT_FAILED, EXIT_USAGE
from smal.files.stored import FORMAT_VERSION
from tests import corridor
from tests.command import run_smal


class Said(NamedTuple):
    """Exit status and errors of a command."""

    returncode: int
    stderr: str


Smal = Callable[..., Said]


@pytest.fixture
def smal(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> Smal:
    """Run a command in this process; what the processes say that it starts counts as well."""

    def run(*arguments: object) -> Said:
        monkeypatch.setattr(sys, "argv", ["smal", *map(str, arguments)])
        with pytest.raises(SystemExit) as ended:
            main()
        assert isinstance(ended.value.code, int)
        return Said(ended.value.code, capfd.readouterr().err)

    return run


def expect_one_line(said: Said, status: int, *named: str) -> None:
    lines = said.stderr.strip().splitlines()
    assert said.returncode == status, said.stderr
    assert len(lines) == 1, said.stderr
    for name in named:
        assert name in lines[0]


def test_unknown_world(smal: Smal, tmp_path: Path) -> None:
    result = smal("demonstrate", "--world", "atlantis", "--episodes", 1, "--out", tmp_path)
    expect_one_line(result, EXIT_USAGE, "atlantis", "campus")


@pytest.mark.system
def test_no_vulkan_driver(tmp_path: Path) -> None:
    result = run_smal(
        "demonstrate", "--world", "yard", "--episodes", 1, "--out", tmp_path, VK_ICD_FILENAMES="/nonexistent.json"
    )
    expect_one_line(Said(result.returncode, result.stderr), EXIT_FAILED, "nonexistent.json", "mesa")


@pytest.mark.zenoh
def test_busy_port(smal: Smal) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        result = smal("up", "--world", "yard", "--router", f"tcp/127.0.0.1:{port}")
    expect_one_line(result, EXIT_FAILED, str(port), "in use")


@pytest.mark.zenoh
def test_no_stack_to_connect_to(smal: Smal, tmp_path: Path) -> None:
    result = smal("demonstrate", "--connect", "tcp/127.0.0.1:9", "--episodes", 1, "--out", tmp_path)
    expect_one_line(result, EXIT_FAILED, "127.0.0.1:9")


@pytest.mark.parametrize("content", [b"", b"not a model", b"SMAL"])
def test_file_that_is_no_model(smal: Smal, tmp_path: Path, content: bytes) -> None:
    model = tmp_path / "broken.smal"
    model.write_bytes(content)
    expect_one_line(smal("run", "--model", model), EXIT_USAGE, "broken.smal")


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return corridor.save_model(tmp_path_factory.mktemp("model") / "mapped.smal")


@pytest.mark.parametrize("command", ["run", "up"])
def test_model_of_another_version(smal: Smal, model: Path, tmp_path: Path, command: str) -> None:
    content = bytearray(model.read_bytes())
    content[8:12] = struct.pack("<I", FORMAT_VERSION + 1)
    newer = tmp_path / "newer.smal"
    newer.write_bytes(content)
    expect_one_line(smal(command, "--model", newer), EXIT_USAGE, "newer.smal", f"format {FORMAT_VERSION + 1}")


def test_places_for_results_are_checked_before_the_stack_starts(smal: Smal, model: Path, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    for option, value in (
        ("--json", tmp_path / "none" / "runs.json"),
        ("--json", tmp_path),
        ("--json", model),
        ("--report", tmp_path / "file"),
        ("--record", tmp_path / "file" / "deeper"),
    ):
        expect_one_line(smal("run", "--model", model, "--world", "yard", option, value), EXIT_USAGE, option, str(value))
    result = smal("demonstrate", "--world", "yard", "--episodes", 1, "--out", tmp_path / "file")
    expect_one_line(result, EXIT_USAGE, "--out", "file")


@pytest.mark.parametrize("command", ["up", "demonstrate"])
def test_robot_that_cannot_be_a_key(smal: Smal, tmp_path: Path, command: str) -> None:
    out = ("--out", tmp_path) if command == "demonstrate" else ()
    expect_one_line(smal(command, "--world", "yard", "--robot", "A B", *out), EXIT_USAGE, "--robot", "A B")


def test_settings_of_the_environment_are_checked(smal: Smal, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SMAL_LOG_LEVEL", "loud")
    result = smal("demonstrate", "--world", "yard", "--episodes", 1, "--out", tmp_path)
    expect_one_line(result, EXIT_USAGE, "log_level")


@pytest.mark.parametrize(
    "arguments",
    [
        ("run",),
        ("nonsense",),
        ("learn", "--out", "x"),
        ("run", "--model", "x", "--episodes", "0"),
        ("demonstrate", "--camera", "big"),
        ("demonstrate", "--seed", "-1"),
        ("demonstrate", "--camera", "160x120", "--connect", "tcp/127.0.0.1:9"),
        ("up", "--stride", "2"),
        ("run", "--model", "x", "--scheme", "dream"),
        ("run", "--model", "x", "--start", "nowhere"),
        ("run", "--model", "x", "--kidnap", "0"),
        ("up", "--model", "none.smal"),
    ],
)
def test_bad_use(smal: Smal, arguments: tuple[str, ...]) -> None:
    expect_one_line(smal(*arguments), EXIT_USAGE)

"""Whatever a user gets wrong is told in one line that names it, with the promised exit status."""

from __future__ import annotations

import socket
from collections.abc import Callable
from pathlib import Path

import pytest

from services.process import EXIT_FAILED, EXIT_USAGE

pytestmark = pytest.mark.system


def expect_one_line(result: object, status: int, *named: str) -> None:
    stderr: str = result.stderr  # type: ignore[attr-defined]
    lines = stderr.strip().splitlines()
    assert result.returncode == status, stderr  # type: ignore[attr-defined]
    assert len(lines) == 1, stderr
    assert "Traceback" not in stderr
    for name in named:
        assert name in lines[0]


def test_unknown_world(smal: Callable[..., object], tmp_path: Path) -> None:
    result = smal("demonstrate", "--world", "atlantis", "--episodes", 1, "--out", tmp_path)
    expect_one_line(result, EXIT_USAGE, "atlantis", "campus")


def test_no_vulkan_driver(smal: Callable[..., object], tmp_path: Path) -> None:
    result = smal(
        "demonstrate", "--world", "yard", "--episodes", 1, "--out", tmp_path, VK_ICD_FILENAMES="/nonexistent.json"
    )
    expect_one_line(result, EXIT_FAILED, "nonexistent.json", "mesa")


def test_busy_port(smal: Callable[..., object]) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        result = smal("up", "--world", "yard", "--router", f"tcp/127.0.0.1:{port}")
    expect_one_line(result, EXIT_FAILED, str(port), "in use")


def test_no_stack_to_connect_to(smal: Callable[..., object], tmp_path: Path) -> None:
    result = smal("demonstrate", "--connect", "tcp/127.0.0.1:9", "--episodes", 1, "--out", tmp_path)
    expect_one_line(result, EXIT_FAILED, "127.0.0.1:9")


@pytest.mark.parametrize("content", [b"", b"not a model", b"SMAL"])
def test_file_that_is_no_model(smal: Callable[..., object], tmp_path: Path, content: bytes) -> None:
    model = tmp_path / "broken.smal"
    model.write_bytes(content)
    expect_one_line(smal("run", "--model", model), EXIT_USAGE, "broken.smal")


def test_missing_model(smal: Callable[..., object], tmp_path: Path) -> None:
    expect_one_line(smal("run", "--model", tmp_path / "none.smal"), EXIT_USAGE, "none.smal")


def test_recordings_that_are_none(smal: Callable[..., object], tmp_path: Path) -> None:
    (tmp_path / "noise.mcap").write_bytes(b"\0" * 100)
    result = smal("learn", tmp_path / "noise.mcap", "--out", tmp_path / "model.smal")
    expect_one_line(result, EXIT_FAILED, "noise.mcap")


@pytest.mark.parametrize(
    "arguments",
    [
        ("run",),
        ("nonsense",),
        ("learn", "--out", "x"),
        ("run", "--model", "x", "--episodes", "0"),
        ("demonstrate", "--camera", "big"),
        ("demonstrate", "--seed", "-1"),
    ],
)
def test_bad_use(smal: Callable[..., object], arguments: tuple[str, ...]) -> None:
    expect_one_line(smal(*arguments), EXIT_USAGE)


@pytest.mark.parametrize("command", ["up", "demonstrate", "teleop", "learn", "run", "topic", "doctor"])
def test_help_shows_an_example(smal: Callable[..., object], command: str) -> None:
    result = smal(command, "--help")
    assert result.returncode == 0  # type: ignore[attr-defined]
    assert "Example" in result.stdout  # type: ignore[attr-defined]

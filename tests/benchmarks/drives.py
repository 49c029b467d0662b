"""Drives and models that a benchmark has made for it, as a user makes them: with the `smal` command."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
from pathlib import Path
from typing import Final

from services.cli.stack.child import tied
from services.kit.errors import JobError
from tests.benchmarks.results import LeftOutError

_SMAL: Final = "from services.cli.main import main; main()"
_STOP_TIMEOUT_S: Final = 9.0


def demonstrate(folder: Path, episodes: int, recoveries: int, world: str = "campus", camera: str = "320x240") -> None:
    """Run `smal demonstrate`; its progress goes to standard error.

    Raises
    ------
    LeftOutError
        It failed; the text is its last line.
    """
    arguments = ["demonstrate", "--world", world, "--episodes", str(episodes), "--recoveries", str(recoveries)]
    arguments += ["--camera", camera, "--out", str(folder)]
    with subprocess.Popen(_command(arguments), stdout=subprocess.DEVNULL, stderr=subprocess.PIPE) as process:
        try:
            said = _pass_on(process)
        except KeyboardInterrupt:
            process.terminate()
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(_STOP_TIMEOUT_S)  # it stops the services that it started
            raise
    if process.returncode:
        lines = said.replace("\r", "\n").strip().splitlines()
        reason = lines[-1].removeprefix("smal: ") if lines else f"status {process.returncode}"
        raise LeftOutError(f"smal demonstrate: {reason}")


def learn(folder: Path) -> Path:
    """Run `smal learn` on the drives in a folder; return the model, in the same folder.

    Raises
    ------
    JobError
        It failed, and has said why on standard error.
    """
    model = folder / "model.smal"
    command = _command(["learn", str(folder), "--out", str(model)])
    if subprocess.run(command, stdout=subprocess.DEVNULL, check=False).returncode:
        raise JobError(f"smal learn {folder} failed")
    return model


def _command(arguments: list[str]) -> list[str]:
    return tied(sys.executable, "-P", "-c", _SMAL, *arguments)


def _pass_on(process: subprocess.Popen[bytes]) -> str:
    """Show what a process writes to standard error until it ends; return the end of it."""
    assert process.stderr is not None
    last = b""
    while said := os.read(process.stderr.fileno(), 4096):
        sys.stderr.buffer.write(said)
        sys.stderr.flush()
        last = (last + said)[-4096:]
    return last.decode(errors="replace")

"""Frames that our simulator rendered along the expert's drives on the campus."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Final

from services.commands.child import tied
from services.commands.teaching import Teacher, find_recordings
from smal.features import Centering, FeatureSettings
from tests.benchmarks.datasets import Recorded
from tests.benchmarks.results import LeftOutError

_SMAL: Final = "from services.cli import main; main()"
#: Of so many drives one is held out for queries.
_HELD_OUT_OF: Final = 6
_STOP_TIMEOUT_S: Final = 9.0


def campus(recordings: Path | None, episodes: int, recoveries: int) -> Recorded:
    """Read drives, or have them driven first into a folder that is removed again.

    Raises
    ------
    LeftOutError
        They cannot be driven here (no Vulkan driver, ...), or are too few.
    """
    if recordings is not None:
        return _read(recordings)
    with tempfile.TemporaryDirectory(prefix="smal-bench-") as folder:
        demonstrate(Path(folder), episodes, recoveries)
        return _read(Path(folder))


def _read(folder: Path) -> Recorded:
    settings = FeatureSettings()
    teacher = Teacher(settings, shortest=1)
    for path in find_recordings([folder]):
        teacher.read(path)
    demonstrations = teacher.teaching.demonstrations
    drives = [one for one in demonstrations if not one.recovery]
    if len(drives) < 2:
        remarks = teacher.teaching.remarks
        raise LeftOutError(f"{len(drives)} usable drives, 2 are needed" + (f" ({remarks[0]})" if remarks else ""))
    queries = drives[-max(1, len(drives) // _HELD_OUT_OF) :]
    taught = [one for one in demonstrations if one not in queries]
    centering = Centering.fit([one.features for one in taught], settings)
    return Recorded(
        "campus",
        [centering.apply(one.features) for one in taught],
        [centering.apply(one.features) for one in queries],
        overlapping=False,
    )


def demonstrate(folder: Path, episodes: int, recoveries: int) -> None:
    """Run `smal demonstrate`; its progress goes to standard error, and its last line is the reason of a failure."""
    arguments = ["demonstrate", "--world", "campus", "--episodes", str(episodes), "--recoveries", str(recoveries)]
    arguments += ["--camera", "320x240", "--out", str(folder)]
    command = tied(sys.executable, "-P", "-c", _SMAL, *arguments)
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE) as process:
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


def _pass_on(process: subprocess.Popen[bytes]) -> str:
    """Show what a process writes to standard error until it ends; return the end of it."""
    assert process.stderr is not None
    last = b""
    while said := os.read(process.stderr.fileno(), 4096):
        sys.stderr.buffer.write(said)
        sys.stderr.flush()
        last = (last + said)[-4096:]
    return last.decode(errors="replace")

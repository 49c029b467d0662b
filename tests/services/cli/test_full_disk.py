"""Results on a disk without room: one line that names the place, and nothing half-written that looks whole."""

import errno
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import pytest

from tests import corridor
from tests.services.cli.conftest import ROOT, Smal
from tests.services.cli.test_adding import run
from tests.services.recordings.test_recorder_files import record

_LIMITED = """
import resource, signal
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, ({most}, {most}))
from services.cli.main import main
main()
"""


def limited(most: int, *arguments: object) -> tuple[int, Sequence[str]]:
    """Run a command whose files may have so many bytes; return its status, and what it printed on standard error."""
    command = [sys.executable, "-c", _LIMITED.format(most=most), *map(str, arguments)]
    environment = os.environ | {
        "PYTHONDONTWRITEBYTECODE": "1"
    }  # Python would leave half-written files of it.
    done = subprocess.run(
        command,
        cwd=ROOT,
        env=environment,
        capture_output=True,
        text=True,
        timeout=500.0,
        check=False,
    )
    return done.returncode, done.stderr.splitlines()


def test_model_page_is_absent_when_the_disk_is_full(
    tmp_path: Path, smal: Smal, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = corridor.save_model(tmp_path / "way.smal")
    out = tmp_path / "shown"

    def full(_descriptor: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr("smal.files.container.os.fsync", full)
    status, _, errors = smal("model", "show", model, "--out", out)
    assert (status, errors) == (1, f"smal: {out / 'index.html'}: No space left on device\n")
    assert list(out.iterdir()) == []


def test_certificates_are_absent_when_the_disk_is_full(tmp_path: Path) -> None:
    keys = tmp_path / "keys"
    status, lines = limited(300, "secure", "init", keys)
    assert (status, lines) == (1, [f"smal: {tmp_path}: File too large"])
    assert list(tmp_path.iterdir()) == []


def test_model_is_absent_when_the_disk_is_full(tmp_path: Path) -> None:
    recording = record(tmp_path, list(run("way", 0.0)))
    model = tmp_path / "way.smal"
    status, lines = limited(100_000, "learn", recording, "--include-runs", "--out", model)
    assert (status, lines[-1]) == (1, f"smal: {model}: File too large")
    assert list(tmp_path.iterdir()) == [recording]


def test_model_stays_when_the_disk_is_full_for_its_copy(tmp_path: Path) -> None:
    drives = tmp_path / "runs"
    drives.mkdir()
    for number in range(4):
        record(drives, list(run(f"run-{number}", 0.6)))
    model = corridor.save_model(tmp_path / "way.smal")
    before = model.read_bytes()
    status, lines = limited(len(before), "learn", drives, "--add", "--out", model)
    assert (status, lines[-1]) == (1, f"smal: {model}: File too large")
    assert model.read_bytes() == before

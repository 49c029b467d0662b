"""A model learns from its runs, goes back, and stays whole on a full disk."""

import errno
import json
import os
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import pytest

from schemas.base import Message
from services.cli.adding import keep, versions
from services.kit.cameras import camera_info
from smal.camera import Camera
from smal.model import Model
from tests import corridor
from tests.services.cli.conftest import ROOT, Mistake, Smal
from tests.services.recordings.recorded_messages import applied, event, header, seen
from tests.services.recordings.test_recorder_files import record


def run(
    name: str, new: float, goal: str = "victim", scale: int = 1, rows: int | None = None
) -> Iterator[Message]:
    """Give a run along the corridor, so much of whose paint is another one."""
    yield event(name, 0, "started", purpose="run").model_copy(update={"goal": goal})
    yield camera_info(header(name, 0), Camera(0.7), scale * corridor.WIDTH, scale * corridor.HEIGHT)
    for frame in range(corridor.FRAMES):
        x_m, y_m, heading_rad = corridor.pose(frame)
        views = [corridor.view(x, y_m, heading_rad, scale)[:rows] for x in (x_m, x_m + 5.0)]
        pixels = (1.0 - new) * views[0] + new * views[1]
        yield from seen(header(name, frame), pixels.astype(np.uint8), (x_m, y_m, heading_rad))
        yield applied(name, frame, atom="forward")
    end = event(name, corridor.FRAMES - 1, "ended", "found", purpose="run")
    yield end.model_copy(update={"goal": goal})


def recorded(folder: Path, many: int, new: float = 0.6, **size: int) -> Path:
    """Make a folder of recorded runs."""
    folder.mkdir()
    for number in range(many):
        record(folder, list(run(f"run-{number}", new, **size)))
    return folder


@pytest.fixture
def runs(tmp_path: Path) -> Path:
    return recorded(tmp_path / "runs", 6)


def test_a_model_learns_from_runs_and_goes_back(runs: Path, tmp_path: Path, smal: Smal) -> None:
    file = corridor.save_model(tmp_path / "way.smal")
    report = tmp_path / "report.json"
    for number, one in enumerate([*runs.iterdir()] * 1000):
        (runs / f"link-{number}.mcap").symlink_to(one)
        (runs / f"name-{number}.mcap").hardlink_to(one)
    before = file.read_bytes()
    status, out, err = smal("learn", runs, "--add", "--out", file, "--json", report)
    assert status == 0, err
    assert "map extended with new view variants" in err
    assert "is left out" not in err, "each file is read once"
    said = json.loads(report.read_text())
    assert (said["taken"], said["runs"], said["judged_by"]) == (True, 6, 3)
    assert len(Model.load(file).mapped.variants) == said["view_variants"] > 0
    assert [one.read_bytes() for one in versions(file)] == [before]
    status, out, _ = smal("model", "back", file)
    assert (status, file.read_bytes()) == (0, before)
    assert "0 earlier versions left" in out


def test_model_learns_when_runs_have_images_of_another_size(tmp_path: Path, smal: Smal) -> None:
    file = corridor.save_model(tmp_path / "way.smal")
    status, _, err = smal("learn", recorded(tmp_path / "runs", 4, scale=2), "--add", "--out", file)
    assert status == 0, err
    assert "images of 128x96 differ from 64x48 in the model; all are resized" in err
    assert "map extended with new view variants" in err


def test_model_stays_when_runs_have_images_of_another_shape(tmp_path: Path, smal: Smal) -> None:
    file = corridor.save_model(tmp_path / "way.smal")
    before = file.read_bytes()
    status, _, err = smal("learn", recorded(tmp_path / "runs", 2, rows=36), "--add", "--out", file)
    assert status == 1
    assert (
        err.count(
            "images of 64x36 differ from 64x48 in the model: another aspect ratio shows another view"
        )
        == 2
    )
    assert file.read_bytes() == before


def test_model_is_unchanged_when_a_drive_adds_no_surprise(tmp_path: Path, smal: Smal) -> None:
    file = corridor.save_model(tmp_path / "way.smal")
    folder = recorded(tmp_path / "runs", 2, new=0.0)
    before = file.read_bytes()
    status, _, err = smal("learn", folder, "--add", "--out", file)
    assert (status, "no unexpected view" in err) == (0, True)
    assert (file.read_bytes(), versions(file)) == (before, [])


def test_ten_versions_are_kept(tmp_path: Path) -> None:
    file = tmp_path / "way.smal"
    for number in range(1, 13):
        file.write_text(str(number))
        assert keep(file).name == f"way.smal.{number}"
    assert [one.read_text() for one in versions(file)] == [str(number) for number in range(3, 13)]


@pytest.mark.parametrize("version", ["truncated", "folder", "link"])
def test_model_stays_when_its_earlier_version_is_invalid(
    tmp_path: Path, mistake: Mistake, version: str
) -> None:
    file = corridor.save_model(tmp_path / "way.smal")
    earlier = tmp_path / "way.smal.1"
    before = file.read_bytes()
    if version == "truncated":
        earlier.write_bytes(before[:100])
    elif version == "folder":
        earlier.mkdir()
    else:
        earlier.symlink_to(file)
    status = 1 if version == "truncated" else 2
    assert "delete it to go back further" in mistake(status, "model", "back", file)
    assert file.read_bytes() == before
    assert not file.is_symlink()


def test_add_reports_model_that_cannot_learn_more(
    runs: Path, tmp_path: Path, smal: Smal, mistake: Mistake
) -> None:
    assert "it is the model to extend" in mistake(
        2, "learn", runs, "--add", "--out", tmp_path / "none.smal"
    )
    file = corridor.save_model(tmp_path / "way.smal")
    one = next(iter(runs.iterdir()))
    status, out, err = smal("learn", one, "--add", "--out", file)
    assert (status, out, "too few runs" in err.splitlines()[-1]) == (1, "", True)
    other = record(tmp_path, list(run("elsewhere", 0.0, "dock")))
    _, _, err = smal("learn", one, other, "--add", "--out", file)
    assert "elsewhere left out: the model has no goal dock" in err
    assert "too few runs" in err.splitlines()[-1]
    assert "--add" in mistake(2, "learn", runs, "--add", "--out", file, "--modalities", "hog")
    corridor.paper_model().save(file)
    assert "cannot learn from runs" in mistake(2, "learn", runs, "--add", "--out", file)
    assert "earlier version not found" in mistake(2, "model", "back", file)


_LIMITED = """
import resource, signal
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, ({most}, {most}))
from services.cli.main import main
main()
"""


def limited(most: int, *arguments: object) -> tuple[int, Sequence[str]]:
    """Run a command with a limit of the size of files; return its status and its standard error."""
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
    status, lines = limited(
        10_000, "learn", recording, "--include-runs", "--modalities", "thumbnail", "--out", model
    )
    assert (status, lines[-1]) == (1, f"smal: {model}: File too large")
    assert list(tmp_path.iterdir()) == [recording]


@pytest.mark.long
def test_model_stays_when_the_disk_is_full_for_its_copy(tmp_path: Path) -> None:
    drives = recorded(tmp_path / "runs", 6)
    model = corridor.save_model(tmp_path / "way.smal")
    before = model.read_bytes()
    status, lines = limited(len(before), "learn", drives, "--add", "--out", model)
    assert (status, lines[-1]) == (1, f"smal: {model}: File too large")
    assert model.read_bytes() == before

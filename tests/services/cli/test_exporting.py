"""``smal export`` as a user runs it."""

import errno
from pathlib import Path

import pytest

from services.exporters import csv_folder
from tests.services.cli.conftest import Smal
from tests.services.exporters.recorded_drive import MADE, recording


@pytest.mark.parametrize("form", ["rosbag2", "lerobot", "folder"])
def test_export_reports_velocities_of_exported_drives(
    form: str, smal: Smal, tmp_path: Path
) -> None:
    pytest.importorskip("pyarrow", reason="needs the extra formats")
    recording(tmp_path / "drives", "one")
    recording(tmp_path / "drives", "two", outcome="timeout")
    (tmp_path / "new/out").mkdir(parents=True)
    status, said, errors = smal(
        "export", form, str(tmp_path / "drives"), "--out", str(tmp_path / "new/out")
    )
    assert status == 0, errors
    assert "drives        2 (1 reached their goal)" in said
    assert f"frames        {2 * len(MADE)} (6 s)" in said
    assert "velocities    of rescuebot: forward 2 m/s (by odometry)" in said
    assert "left 0.785 rad/s (by odometry)" in said
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["out"]


@pytest.mark.parametrize(
    "failure", [OSError(errno.ENOSPC, "No space left on device"), KeyboardInterrupt()]
)
def test_export_removes_its_files_when_writing_fails(
    failure: BaseException, smal: Smal, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recording(tmp_path / "drives")

    def fail(_drives: object, folder: Path, *_others: object) -> None:
        (folder / "half").write_text("of it")
        raise failure

    monkeypatch.setattr(csv_folder, "write", fail)
    status, _, errors = smal(
        "export", "folder", str(tmp_path / "drives"), "--out", str(tmp_path / "out")
    )
    assert status != 0
    assert errors.count("\n") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["drives"]

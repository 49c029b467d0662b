"""``smal export`` as a user runs it."""

import errno
import os
from pathlib import Path

import pytest

from services.exporters import csv_folder
from services.recordings.sink import claim
from tests.services.cli.conftest import Mistake, Smal
from tests.services.exporters.recorded_drive import MADE, recording


@pytest.mark.parametrize("form", ["rosbag2", "lerobot", "folder"])
def test_drives_are_exported_and_it_is_said_how_fast_they_were(form: str, smal: Smal, tmp_path: Path) -> None:
    pytest.importorskip("pyarrow", reason="needs the extra formats")
    recording(tmp_path / "drives", "one")
    recording(tmp_path / "drives", "two", outcome="timeout")
    (tmp_path / "new/out").mkdir(parents=True)
    status, said, errors = smal("export", form, str(tmp_path / "drives"), "--out", str(tmp_path / "new/out"))
    assert status == 0, errors
    assert "drives        2 (1 reached their goal)" in said
    assert f"frames        {2 * len(MADE)} (6 s)" in said
    assert "velocities    of rescuebot: forward 2 m/s (by its odometry)" in said
    assert "left 0.785 rad/s (by its odometry)" in said
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["out"]


@pytest.mark.parametrize(
    ("arguments", "status", "said"),
    [
        (("folder", "no-such"), 2, "no-such: no such file or folder"),
        (("folder", "notes.txt"), 1, "notes.txt: not an MCAP file"),
        (("folder", "drives", "--out", "full"), 2, "--out full: exists and is not empty; give another name"),
        (("folder", "recorded/drive.mcap.partial"), 1, "still being recorded; end the episode or stop the recorder"),
        (("folder", "blind"), 1, "blind.mcap: holds no camera frame"),
        (("folder", "lost"), 1, "episode lost: no odometry says how fast forward is; say it with --speed"),
    ],
)
def test_what_cannot_be_done_is_one_line_and_leaves_nothing(
    arguments: tuple[str, ...],
    status: int,
    said: str,
    mistake: Mistake,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    recording(Path("drives"))
    recording(Path("blind"), "blind", images=False)
    recording(Path("lost"), "lost", odometry=False)
    Path("full").mkdir()
    Path("notes.txt").write_text("words")
    Path("full/notes.txt").write_text("words")
    lock = claim(recording(Path("recorded"), outcome=None))
    before = sorted(path for path in tmp_path.rglob("*"))
    arguments = arguments if "--out" in arguments else (*arguments, "--out", "out")
    try:
        assert said in mistake(status, "export", *arguments)
    finally:
        os.close(lock)
    assert sorted(path for path in tmp_path.rglob("*")) == before


@pytest.mark.parametrize("failure", [OSError(errno.ENOSPC, "No space left on device"), KeyboardInterrupt()])
def test_an_export_that_fails_half_way_leaves_nothing(
    failure: BaseException, smal: Smal, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recording(tmp_path / "drives")

    def fail(_drives: object, folder: Path, *_others: object) -> None:
        (folder / "half").write_text("of it")
        raise failure

    monkeypatch.setattr(csv_folder, "write", fail)
    status, _, errors = smal("export", "folder", str(tmp_path / "drives"), "--out", str(tmp_path / "out"))
    assert status != 0
    assert errors.count("\n") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["drives"]

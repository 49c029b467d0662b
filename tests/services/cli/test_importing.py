"""``smal import`` as a user runs it."""

import json
import sys
from pathlib import Path

import pytest

from services.cli import importing
from services.importers import job
from services.kit.cameras import camera_of
from services.recordings.reader import read_recording
from smal.files import confined
from tests.services.cli.conftest import Mistake, Smal
from tests.services.importers import sources

KEY = "observation.images.front"


def test_a_folder_becomes_recordings_that_teach(smal: Smal, tmp_path: Path) -> None:
    folder = sources.csv_folder(tmp_path / "set")
    out = tmp_path / "drives"
    report = tmp_path / "report.json"
    more = ("--goal", "dock", "--json", report, "--field-of-view", "60")
    status, said, errors = smal("import", "folder", folder, "--out", out, *more)
    assert status == 0
    assert "drives        1 (1 reached dock)" in said
    assert "nominal       2 m/s, 0.8 rad/s" in said
    assert "actions       forward 74%, left 12%, right 12%, stop 3%" in said
    assert f"recordings in {out}; next: smal learn {out} --out MODEL" in said
    assert "frames between two ticks are not needed" in errors
    (file,) = out.iterdir()
    (episode,) = read_recording(file).episodes
    assert (episode.goal, episode.outcome) == ("dock", "found")
    assert camera_of(episode.camera).field_deg == pytest.approx(60.0, abs=0.1)
    assert json.loads(report.read_text())["files"] == [str(file)]
    status, said, errors = smal(
        "learn", str(out), "--out", str(tmp_path / "m.smal"), "--modalities", "thumbnail"
    )
    assert status == 0, errors
    assert "goals           dock" in said


def test_missing_packages_are_named_in_one_line(
    mistake: Mistake, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    monkeypatch.setattr(job, "missing_packages", lambda _form: ["pyarrow", "av"])
    said = mistake(2, "import", "lerobot", "x")
    assert said == "smal: lerobot needs pyarrow and av: pip install -e '.[formats]'\n"


@pytest.mark.parametrize(
    ("work", "said"),
    [
        ("crash", "the file is damaged, or hostile"),
        ("fill", "more than 2 GiB of memory"),
        ("loop", "s of processor time; if it is sound, SMAL_LIMITS=2 doubles the limit"),
    ],
)
def test_a_decoder_that_breaks_down_is_one_line(
    mistake: Mistake, work: str, said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[3]))
    monkeypatch.setattr(importing, "_WORK", f"tests.confined_work:{work}")
    if work == "loop":
        monkeypatch.setattr(confined, "LEAST_S", 1.0)
    monkeypatch.setattr(confined, "_WAITING", 1e3)  # On a loaded machine the clock runs far ahead.
    assert said in mistake(1, "import", "folder", str(tmp_path), "--out", str(tmp_path / "out"))
    assert not (tmp_path / "out").exists()


def test_a_bag_becomes_recordings(smal: Smal, tmp_path: Path) -> None:
    bag = sources.rosbag2(tmp_path / "mybag")
    status, out, err = smal("import", "rosbag2", bag, "--out", tmp_path / "drives")
    assert status == 0, err
    assert f"recordings in {tmp_path / 'drives'}; next: smal learn" in out
    assert len(list((tmp_path / "drives").glob("*.mcap"))) == 1

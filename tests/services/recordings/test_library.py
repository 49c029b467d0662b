"""`smal.recordings`, the door of the library; and the library alone, without the stack."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import smal
from tests import corridor
from tests.services.recordings import driven_corridor

#: Runs code as if only the library's own packages were installed.
WITHOUT_STACK = """
import sys
class Missing:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {stack!r}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)
sys.meta_path.insert(0, Missing())
"""
STACK = ("typer", "click", "pydantic", "mcap", "msgpack", "zenoh", "distributed", "dask", "tqdm")


def without_stack(code: str) -> subprocess.CompletedProcess[str]:
    program = WITHOUT_STACK.format(stack=STACK) + code
    return subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=False
    )


def test_recording_gives_images_actions_and_poses(tmp_path: Path) -> None:
    path = driven_corridor.record(tmp_path)
    (one,) = smal.recordings.read(path, corridor.FEATURES)
    (same,) = smal.recordings.read(tmp_path, corridor.FEATURES)
    assert one.name == same.name == driven_corridor.NAME
    assert one.images is not None
    assert one.images[0].shape == (corridor.HEIGHT, corridor.WIDTH, 3)
    assert one.atoms.tolist()[:3] == [smal.Atom.FORWARD] * 3
    assert one.odometry is not None
    np.testing.assert_allclose(one.odometry[7], driven_corridor.pose(7))
    assert one.camera is not None
    assert smal.learn([one], corridor.FEATURES).mapped.frames.tolist() == [len(one.atoms)]


def test_reading_is_rejected_when_there_is_no_recording(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"none\.mcap: not found"):
        smal.recordings.read(tmp_path / "none.mcap")
    with pytest.raises(ValueError, match="no recording"):
        smal.recordings.read(tmp_path)
    (tmp_path / "x.mcap").write_bytes(b"not a recording")
    with pytest.raises(ValueError, match="not an MCAP file"):
        smal.recordings.read(tmp_path / "x.mcap")


def test_library_learns_and_drives_when_the_stack_is_missing() -> None:
    ran = without_stack(
        "import smal\n"
        "from tests import corridor\n"
        "images, atoms, poses = corridor.drive()\n"
        "robot = smal.Robot(smal.fit([(images, atoms, poses)], corridor.FEATURES))\n"
        "print(robot.step(images[0], poses[0]))\n"
    )
    assert ran.returncode == 0, ran.stderr
    assert ran.stdout.startswith("(")


@pytest.mark.parametrize(
    "code",
    ["import smal; smal.recordings.read('way.mcap')", "from services.cli.main import main"],
)
def test_missing_stack_is_named_with_the_installing_command(code: str) -> None:
    ran = without_stack(code)
    assert ran.returncode == 1
    assert "pip install 'smal[stack]'" in ran.stderr.splitlines()[-1]

"""A loaded model keeps its content when its file changes."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from smal.files import container, held

VERSION = 1
NUMBERS = np.arange(200_000, dtype=np.float64)
READ = """
import os, sys
from pathlib import Path
from smal.files import container
path = Path(sys.argv[1])
with path.open("rb") as file:
    numbers = container.read(file, "model", 1)[1]["numbers"]
"""


@pytest.fixture
def path(tmp_path: Path) -> Path:
    path = tmp_path / "model.smal"
    container.write(path, VERSION, {}, {"numbers": NUMBERS})
    return path


def numbers(path: Path) -> np.ndarray:
    with path.open("rb") as file:
        return container.read(file, "model", VERSION)[1]["numbers"]


def test_model_keeps_its_content_when_its_file_is_overwritten(path: Path) -> None:
    loaded = numbers(path)
    with path.open("r+b") as file:
        file.write(os.urandom(path.stat().st_size))
    np.testing.assert_array_equal(loaded, NUMBERS)


def test_process_survives_when_its_model_is_truncated(path: Path) -> None:
    program = READ + "os.truncate(path, 0)\nprint(numbers.sum())"
    done = subprocess.run(
        [sys.executable, "-c", program, path], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0
    assert float(done.stdout) == NUMBERS.sum()


def test_altered_file_is_refused_when_a_sound_copy_is_loaded(path: Path) -> None:
    loaded = numbers(path)
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)
    with pytest.raises(container.ModelError, match="truncated or altered"):
        numbers(path)
    np.testing.assert_array_equal(loaded, NUMBERS)


def test_content_is_read_only_when_it_is_loaded(path: Path) -> None:
    assert not numbers(path).flags.writeable


def test_content_is_whole_when_there_is_no_memory_file(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(held, "_LINUX", False)
    loaded = numbers(path)
    path.write_bytes(b"")
    np.testing.assert_array_equal(loaded, NUMBERS)
    assert not loaded.flags.writeable


@pytest.mark.skipif(sys.platform != "linux", reason="shares memory files of Linux")
def test_processes_share_one_copy_when_they_load_one_model(path: Path) -> None:
    program = (
        READ
        + "print(*[line.split()[4] for line in open('/proc/self/maps') if 'memfd:smal' in line], flush=True)"
    )
    command = [sys.executable, "-c", program + "\nsys.stdin.read()", path]
    processes = [
        subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        for _ in range(2)
    ]
    try:
        # The second one may begin before the first has its copy; a third begins after both.
        inodes = [
            process.stdout.readline().split() for process in processes if process.stdout is not None
        ]
        third = subprocess.run(
            command, input="", capture_output=True, text=True, check=True
        ).stdout.split()
    finally:
        for process in processes:
            process.communicate()
    assert [len(each) for each in inodes] == [1, 1]
    assert third in inodes

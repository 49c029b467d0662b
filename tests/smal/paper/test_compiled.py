"""Machine code that is kept on disk is that of the source as it is now."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from smal.paper.compiled import compiled

_CALLEE = """
from smal.paper.compiled import compiled
LIMIT = {limit}
@compiled
def inner(x):
    return x + {added}
"""
_CALLER = """
from callee import LIMIT, inner
from smal.paper.compiled import compiled
@compiled
def outer(x):
    return min(inner(x), LIMIT)
print(outer(1.0), sum(outer.stats.cache_hits.values()))
"""


#: A file system that is mounted read-only, as far as a process sees it: rights do not bind root, who may run the tests.
_READ_ONLY = """
import os, pathlib
access, mkdir = os.access, pathlib.Path.mkdir
def make(folder, *how, **more):
    if "kept" in folder.parts and not folder.exists():
        raise OSError(30, "Read-only file system")
    mkdir(folder, *how, **more)
pathlib.Path.mkdir = make
os.access = lambda path, mode, **how: "kept" not in str(path) and access(path, mode, **how)
import caller
"""


def run(folder: Path, code: str = "import caller") -> list[float]:
    """Return what the function says, and whether it was found on disk."""
    paths = os.pathsep.join([str(folder), str(Path.cwd())])
    settings = os.environ | {
        "PYTHONPATH": paths,
        "NUMBA_CACHE_DIR": str(folder / "kept"),
        "PYTHONDONTWRITEBYTECODE": "1",
    }
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=True, env=settings
    )
    return [float(one) for one in done.stdout.split()]


def test_functions_that_were_compiled_into_another_one_are_not_forgotten(tmp_path: Path) -> None:
    (tmp_path / "caller.py").write_text(_CALLER)
    callee = tmp_path / "callee.py"
    callee.write_text(_CALLEE.format(limit=100.0, added=10.0))
    assert run(tmp_path) == [11.0, 0.0]
    assert run(tmp_path) == [11.0, 1.0]
    callee.write_text(_CALLEE.format(limit=100.0, added=2.0))
    assert run(tmp_path) == [3.0, 0.0]
    callee.write_text(_CALLEE.format(limit=2.5, added=2.0))
    assert run(tmp_path) == [2.5, 0.0]
    assert run(tmp_path) == [2.5, 1.0]


def test_what_can_only_be_read_is_used_and_what_is_not_there_is_no_error(tmp_path: Path) -> None:
    """As with a volume that is mounted read-only: who could write it could have others run what they like."""
    (tmp_path / "caller.py").write_text(_CALLER)
    callee = tmp_path / "callee.py"
    callee.write_text(_CALLEE.format(limit=100.0, added=10.0))
    assert run(tmp_path) == [11.0, 0.0]
    kept = sorted(tmp_path.glob("kept/**/*"))
    assert run(tmp_path, _READ_ONLY) == [11.0, 1.0]
    callee.write_text(_CALLEE.format(limit=100.0, added=3.0))
    for folder in tmp_path.glob("kept/*"):
        folder.chmod(0o555)
    assert run(tmp_path, _READ_ONLY) == [4.0, 0.0]
    assert [path for path in sorted(tmp_path.glob("kept/**/*")) if path.is_file()] == [p for p in kept if p.is_file()]


def test_the_library_runs_without_compilation() -> None:
    """As debuggers, coverage and fuzzers need it."""
    settings = os.environ | {"NUMBA_DISABLE_JIT": "1"}
    code = "import smal.paper.matching.products, smal.paper.matching.streaming"
    subprocess.run([sys.executable, "-c", code], timeout=120, check=True, env=settings)


def test_where_numba_can_keep_nothing_each_process_compiles_for_itself(monkeypatch: pytest.MonkeyPatch) -> None:
    """As in a container that may write nowhere: the folder is there, and read-only."""

    def refuse(*_: object) -> None:
        raise RuntimeError("cannot cache function 'half': no locator available")

    monkeypatch.setattr("numba.core.caching.CacheImpl.__init__", refuse)

    def half(x: float) -> float:
        return x / 2.0

    assert compiled(half)(3.0) == 1.5

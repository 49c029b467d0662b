"""The wheel is complete: build it, unpack it elsewhere, and run it."""

import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from tests.services.waiting import DEADLINE_S

pytestmark = pytest.mark.system
ROOT = Path(__file__).parents[2]
PACKAGES = ("smal", "schemas", "services")
BUILD = "import sys; from setuptools.build_meta import build_wheel; build_wheel(sys.argv[1])"
SMAL = "from services.cli.main import main; main()"


def _run(*arguments: object, folder: Path, **environment: str) -> str:
    usual = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    command = [sys.executable, "-P", "-c", *map(str, arguments)]
    done = subprocess.run(
        command,
        cwd=folder,
        env=usual | environment,
        capture_output=True,
        text=True,
        timeout=DEADLINE_S,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build it from a copy: what setuptools leaves behind does not belong in the checkout."""
    source = tmp_path_factory.mktemp("source")
    out = tmp_path_factory.mktemp("wheel")
    for name in PACKAGES:
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md"):
        shutil.copy(ROOT / name, source)
    _run(BUILD, out, folder=source)
    (built,) = out.glob("*.whl")
    return built


def test_wheel_has_every_file_of_the_packages(wheel: Path) -> None:
    within = set(zipfile.ZipFile(wheel).namelist())
    of_checkout = (path for name in PACKAGES for path in (ROOT / name).rglob("*") if path.is_file())
    # Pages are read in the checkout.
    of_source = (
        path for path in of_checkout if path.suffix != ".md" and "__pycache__" not in path.parts
    )
    wanted = {str(path.relative_to(ROOT)) for path in of_source}
    assert not sorted(wanted - within)
    (entries,) = (name for name in within if name.endswith(".dist-info/entry_points.txt"))
    assert "smal = services.cli.main:main" in zipfile.ZipFile(wheel).read(entries).decode()


@pytest.mark.rendering
def test_world_is_drawn_by_its_name_from_another_folder(wheel: Path, tmp_path: Path) -> None:
    installed = tmp_path / "installed"
    zipfile.ZipFile(wheel).extractall(installed)
    # It comes before the project in development mode.
    where = {"PYTHONPATH": str(installed)}
    assert str(installed) in _run(
        "import services.cli as one; print(one.__file__)", folder=tmp_path, **where
    )
    wanted = ("--views", 2, "--camera", "64x48", "--out", "views")
    assert "wrote the map and 2 views in views" in _run(
        SMAL, "world", "render", "yard", *wanted, folder=tmp_path, **where
    )
    assert len(list((tmp_path / "views").glob("*.png"))) == 3

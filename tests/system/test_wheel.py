"""The project as a wheel has all that it needs: it is built, installed in an empty environment, and run elsewhere."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import sysconfig
import venv
import zipfile
from pathlib import Path

import pytest

pytestmark = [pytest.mark.system, pytest.mark.timeout(600)]
ROOT = Path(__file__).parents[2]
PACKAGES = ("smal", "schemas", "services")


def _pip(*arguments: object) -> None:
    command = [sys.executable, "-m", "pip", "--disable-pip-version-check", *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build it from a copy: what setuptools leaves behind does not belong in the checkout."""
    source, out = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("wheel")
    for name in PACKAGES:
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md"):
        shutil.copy(ROOT / name, source)
    _pip("wheel", "--quiet", "--no-deps", "--no-build-isolation", "--no-index", "--wheel-dir", out, source)
    (built,) = out.glob("*.whl")
    return built


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Install it in an environment that sees this one's libraries, but not the project; return its programs."""
    environment = tmp_path_factory.mktemp("environment")
    venv.create(environment)
    libraries = sysconfig.get_path("purelib", vars={"base": str(environment)})
    # A folder that is named here, unlike one of Python's own, has its `.pth` files not read: the project in
    # development mode is not found there.
    (Path(libraries) / "libraries.pth").write_text(sysconfig.get_path("purelib"))
    _pip("--python", environment / "bin" / "python", "install", "--quiet", "--no-deps", "--no-index", wheel)
    return environment / "bin"


def _run(*command: object, folder: Path) -> str:
    environment = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    done = subprocess.run(
        list(map(str, command)), cwd=folder, env=environment, capture_output=True, text=True, timeout=500, check=False
    )
    assert done.returncode == 0, done.stderr
    assert "warning" not in done.stderr
    return done.stdout


def test_the_wheel_has_every_file_of_the_packages(wheel: Path) -> None:
    within = set(zipfile.ZipFile(wheel).namelist())
    of_checkout = (path for name in PACKAGES for path in (ROOT / name).rglob("*") if path.is_file())
    # Pages are read in the checkout.
    of_source = (path for path in of_checkout if path.suffix != ".md" and "__pycache__" not in path.parts)
    wanted = {str(path.relative_to(ROOT)) for path in of_source}
    assert not sorted(wanted - within)


@pytest.mark.rendering
def test_a_world_by_its_name_is_demonstrated_from_another_folder(installed: Path, tmp_path: Path) -> None:
    command = (installed / "smal", "demonstrate", "--world", "campus", "--camera", "64x48", "--out", "drives")
    assert "recorded 1 drives in drives" in _run(*command, folder=tmp_path)
    assert len(list((tmp_path / "drives").glob("*.mcap"))) == 1

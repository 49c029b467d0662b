"""The wheel and the demo as a new user runs them: from a wheel, by the script, in a browser."""

import json
import os
import shutil
import signal
import subprocess
import sys
import sysconfig
import urllib.request
import zipfile
from pathlib import Path

import pytest

from services.cli.stack import free_endpoint
from tests.services.waiting import DEADLINE_S, eventually

pytestmark = [pytest.mark.system, pytest.mark.timeout(1500)]
ROOT = Path(__file__).parents[2]
PACKAGES = ("smal", "schemas", "services")
BUILD = "import sys; from setuptools.build_meta import build_wheel; build_wheel(sys.argv[1])"


def environment(**own: str) -> dict[str, str]:
    usual = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    return usual | {"SMAL_ROUTER": free_endpoint()} | own


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build it from a copy: what setuptools leaves behind does not belong in the checkout."""
    source = tmp_path_factory.mktemp("source")
    out = tmp_path_factory.mktemp("wheel")
    for name in PACKAGES:
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md"):
        shutil.copy(ROOT / name, source)
    subprocess.run(
        [sys.executable, "-P", "-c", BUILD, out], cwd=source, env=environment(), check=True
    )
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


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Install the wheel in an empty environment, which finds other packages in this environment."""
    folder = tmp_path_factory.mktemp("installed") / "env"
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", folder], check=True)
    python = folder / "bin" / "python"
    uv = (sys.executable, "-m", "uv", "pip", "install", "-q", "--offline", "--no-deps")
    subprocess.run([*uv, "--python", python, wheel], check=True)
    (site,) = folder.glob("lib/python*/site-packages")
    # A path in a .pth file reads no .pth file there, such as the project's own.
    (site / "requirements.pth").write_text(sysconfig.get_path("purelib") + "\n")
    where = "import services; print(services.__file__)"
    done = subprocess.run(
        [python, "-P", "-c", where], env=environment(), capture_output=True, text=True, check=True
    )
    assert str(site) in done.stdout
    return folder / "bin" / "smal"


@pytest.mark.rendering
def test_demo_finds_the_victim_from_a_wheel(installed: Path, near: Path, tmp_path: Path) -> None:
    small = ("--world", near, "--camera", "160x120", "--runs", "1", "--out", "results")
    done = subprocess.run(
        [installed, "demo", *small],
        cwd=tmp_path,
        env=environment(),
        capture_output=True,
        text=True,
        timeout=3 * DEADLINE_S,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    page = tmp_path / "results" / "report" / "index.html"
    assert f"Open this page: {page}" in done.stdout
    assert "Play" in page.read_text()
    (run,) = json.loads((tmp_path / "results" / "runs.json").read_text())["episodes"]
    assert run["outcome"] == "found"


def test_script_passes_its_options_to_the_demo(tmp_path: Path) -> None:
    """Run it beside a script of setup that does nothing."""
    (tmp_path / "deploy").mkdir()
    script = tmp_path / "deploy" / "demo.sh"
    script.write_text((ROOT / "deploy" / "demo.sh").read_text())
    (tmp_path / "deploy" / "setup.sh").write_text("echo set up\n")
    (tmp_path / ".venv" / "bin").mkdir(parents=True)
    smal = tmp_path / ".venv" / "bin" / "smal"
    program = "from services.cli.main import main; main()"
    smal.write_text(f'#!/bin/sh\nexec {sys.executable} -c "{program}" "$@"\n')
    smal.chmod(0o755)
    done = subprocess.run(["bash", script, "--help"], capture_output=True, text=True, check=True)
    assert done.stdout.startswith("set up\nUsage: smal demo ")


def test_setup_ends_with_the_next_command() -> None:
    last = (ROOT / "deploy" / "setup.sh").read_text().splitlines()[-1]
    assert last == 'say "done; next: source .venv/bin/activate"'


@pytest.mark.long
@pytest.mark.rendering
def test_demo_opens_the_page_in_the_browser(near: Path, tmp_path: Path) -> None:
    browser = tmp_path / "browser"
    opened = tmp_path / "opened"
    browser.write_text(f'#!/bin/sh\necho "$1" > {opened}.new; mv {opened}.new {opened}\n')
    browser.chmod(0o755)
    page = free_endpoint().removeprefix("tcp/")
    own = {"BROWSER": f"{browser} %s", "DISPLAY": ":9", "SMAL_CONSOLE": page}
    smal = (sys.executable, "-c", "from services.cli.main import main; main()")
    demo = subprocess.Popen(
        [*smal, "demo", "--browser", "--world", near, "--camera", "160x120"],
        cwd=tmp_path,
        env=environment(**own),
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        eventually(opened.exists)
        address = opened.read_text().strip()
        assert address == f"http://{page}"
        with urllib.request.urlopen(address) as content:  # noqa: S310 - our own page
            assert b"<title>" in content.read()
    finally:
        demo.send_signal(signal.SIGINT)
        _, told = demo.communicate(timeout=DEADLINE_S)
    assert demo.returncode == 130
    assert f"ready: open http://{page}\n" in told

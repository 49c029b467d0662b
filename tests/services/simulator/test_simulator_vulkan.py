"""The choice of a Vulkan driver: software only where there is no graphics device, and plain words where nothing is."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from services.simulator.scene.vulkan import RenderingUnavailableError, choose_driver


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name in ("intel_icd.json", "lvp_icd.x86_64.json", "nvidia_icd.json"):
        (tmp_path / name).write_text("{}")
    return tmp_path


def test_without_a_graphics_device_the_software_driver_is_named(folder: Path) -> None:
    assert choose_driver({}, [folder], gpu=False) == folder / "lvp_icd.x86_64.json"


def test_with_a_graphics_device_the_choice_is_the_loaders(folder: Path) -> None:
    assert choose_driver({}, [folder], gpu=True) is None


def test_a_users_choice_stands(folder: Path) -> None:
    chosen = str(folder / "intel_icd.json")
    assert choose_driver({"VK_ICD_FILENAMES": chosen}, [folder], gpu=False) is None
    assert choose_driver({"VK_DRIVER_FILES": chosen}, [folder], gpu=False) is None


def test_a_users_choice_that_does_not_exist_is_named(folder: Path) -> None:
    with pytest.raises(RenderingUnavailableError, match=r"names /nowhere\.json, a missing file"):
        choose_driver({"VK_ICD_FILENAMES": "/nowhere.json"}, [folder], gpu=False)


@pytest.mark.parametrize("gpu", [False, True])
def test_no_driver_at_all_says_what_to_install(tmp_path: Path, gpu: bool) -> None:
    with pytest.raises(RenderingUnavailableError, match=r"no Vulkan driver found; install Mesa 24\.3"):
        choose_driver({}, [tmp_path / "absent", tmp_path], gpu=gpu)


def test_only_hardware_drivers_without_hardware_are_as_good_as_none(tmp_path: Path) -> None:
    (tmp_path / "nvidia_icd.json").write_text("{}")
    with pytest.raises(RenderingUnavailableError, match="no Vulkan driver found"):
        choose_driver({}, [tmp_path], gpu=False)


@pytest.mark.rendering
def test_a_driver_that_cannot_render_gives_one_line_and_no_crash(tmp_path: Path) -> None:
    broken = tmp_path / "broken_icd.json"
    broken.write_text(
        '{"file_format_version": "1.0.0", "ICD": {"library_path": "/nowhere.so", "api_version": "1.3.0"}}'
    )
    program = (
        "from services.simulator.simulation import CameraSettings, Simulation\n"
        "from services.simulator.scene.vulkan import RenderingUnavailableError\n"
        "from services.simulator.world import load_world\n"
        "try:\n"
        "    Simulation(load_world('yard'), CameraSettings(64, 48))\n"
        "except RenderingUnavailableError as error:\n"
        "    print('UNAVAILABLE', error)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", program],
        env={**os.environ, "VK_ICD_FILENAMES": str(broken)},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    line = next(line for line in done.stdout.splitlines() if line.startswith("UNAVAILABLE"))
    assert "mesa-vulkan-drivers" in line

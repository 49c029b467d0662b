"""The choice of a Vulkan driver: software only where there is no graphics device, and plain words where nothing is."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from services.simulator.scene.vulkan import RenderingUnavailableError, choose_driver


@pytest.mark.parametrize(
    ("environment", "gpu", "chosen"),
    [
        ({}, False, "lvp_icd.x86_64.json"),
        ({}, True, None),
        ({"VK_ICD_FILENAMES": "intel_icd.json"}, False, None),
        ({"VK_DRIVER_FILES": "intel_icd.json"}, False, None),
    ],
)
def test_the_software_driver_is_named_where_neither_a_device_nor_the_user_chooses(
    environment: dict[str, str], gpu: bool, chosen: str | None, tmp_path: Path
) -> None:
    for name in ("intel_icd.json", "lvp_icd.x86_64.json", "nvidia_icd.json"):
        (tmp_path / name).write_text("{}")
    named = {name: str(tmp_path / file) for name, file in environment.items()}
    assert choose_driver(named, [tmp_path], gpu=gpu) == (None if chosen is None else tmp_path / chosen)


@pytest.mark.parametrize("gpu", [False, True])
def test_no_driver_that_could_work_says_what_to_install(tmp_path: Path, gpu: bool) -> None:
    if not gpu:
        (tmp_path / "nvidia_icd.json").write_text("{}")
    with pytest.raises(RenderingUnavailableError, match=r"no Vulkan driver found; install Mesa 24\.3"):
        choose_driver({}, [tmp_path / "absent", tmp_path], gpu=gpu)
    with pytest.raises(RenderingUnavailableError, match=r"names /nowhere\.json, a missing file"):
        choose_driver({"VK_ICD_FILENAMES": "/nowhere.json"}, [tmp_path], gpu=gpu)


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

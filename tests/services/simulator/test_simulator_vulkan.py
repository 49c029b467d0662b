"""The choice of a Vulkan driver: software only where there is no graphics device, and plain words where nothing is."""

from __future__ import annotations

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

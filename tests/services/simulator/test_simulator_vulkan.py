"""The choice of a Vulkan driver: software only where there is no graphics device, and plain words where nothing is."""

from __future__ import annotations

from pathlib import Path

import pytest

from services.simulator.scene.vulkan import choose_driver


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

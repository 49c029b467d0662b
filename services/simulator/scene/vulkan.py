"""Choose a Vulkan driver before the renderer does, and report a missing driver."""

import ctypes.util
import os
from collections.abc import Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, Final

from services.kit.errors import JobError

DRIVER_FOLDERS: Final = tuple(
    Path(folder) / "vulkan" / "icd.d" for folder in ("/etc", "/usr/local/share", "/usr/share")
)
INSTALL: Final = "install Mesa 24.3 or newer: apt-get install mesa-vulkan-drivers (Debian 12: from bookworm-backports)"


class UnavailableError(JobError):
    """The machine cannot render, or SAPIEN is missing; the message names the package to install."""


def cannot_render(error: RuntimeError) -> UnavailableError:
    """Return the error of an installed driver that fails."""
    return UnavailableError(f"the Vulkan driver cannot render ({error}); {INSTALL}")


@lru_cache
def load_sapien(*, rendering: bool = True) -> Any:
    """Import SAPIEN after choosing a Vulkan driver; raises UnavailableError if one is missing."""
    try:
        _prepare()
    except UnavailableError:
        # Physics needs no driver.
        if rendering:
            raise
    try:
        import sapien  # noqa: PLC0415

        if rendering:
            import sapien.render  # noqa: PLC0415
    except (ImportError, OSError) as error:
        raise UnavailableError(
            f"SAPIEN cannot be loaded ({error}); pip install -e '.[simulator]'"
        ) from error
    return sapien


def _prepare() -> None:
    if ctypes.util.find_library("vulkan") is None:
        raise UnavailableError(
            f"Vulkan loader (libvulkan.so.1) not found; {INSTALL} and libvulkan1"
        )
    # A GPU driver needs a graphics device.
    gpu = Path("/dev/nvidiactl").exists() or any(Path("/dev/dri").glob("renderD*"))
    driver = choose_driver(os.environ, DRIVER_FOLDERS, gpu)
    if driver is not None:
        os.environ["VK_ICD_FILENAMES"] = str(driver)


def choose_driver(
    environment: Mapping[str, str], folders: Sequence[Path], gpu: bool
) -> Path | None:
    """Return the software driver's file if there is no GPU and no choice by the user."""
    chosen = environment.get("VK_DRIVER_FILES") or environment.get("VK_ICD_FILENAMES")
    if chosen:
        missing = [name for name in chosen.split(os.pathsep) if not Path(name).is_file()]
        if missing:
            raise UnavailableError(
                f"VK_ICD_FILENAMES: {missing[0]} not found; unset it, or {INSTALL}"
            )
        return None
    installed = [path for folder in folders for path in sorted(folder.glob("*.json"))]
    if gpu and installed:
        return None
    software = [path for path in installed if path.match("lvp_icd*.json")]
    if not software:
        raise UnavailableError(f"Vulkan driver not found; {INSTALL}")
    return software[0]

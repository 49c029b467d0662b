"""Find a Vulkan driver before the renderer looks for one, and say plainly when there is none."""

from __future__ import annotations

import ctypes.util
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

DRIVER_FOLDERS: Final = tuple(
    Path(folder) / "vulkan" / "icd.d" for folder in ("/etc", "/usr/local/share", "/usr/share")
)
INSTALL: Final = "install Mesa 24.3 or newer: apt-get install mesa-vulkan-drivers (Debian 12: from bookworm-backports)"


class RenderingUnavailableError(Exception):
    """No image can be made on this machine; the message is one line that says what to install."""


def cannot_render(error: RuntimeError) -> RenderingUnavailableError:
    """Return the error of a driver that is there and fails."""
    return RenderingUnavailableError(f"the Vulkan driver cannot render ({error}); {INSTALL}")


def prepare() -> None:
    """Choose the Vulkan driver for this process; call before the first import of sapien."""
    if ctypes.util.find_library("vulkan") is None:
        raise RenderingUnavailableError(f"no Vulkan loader (libvulkan.so.1); {INSTALL} and libvulkan1")
    # Without a graphics device a GPU's driver is of no use.
    gpu = Path("/dev/nvidiactl").exists() or any(Path("/dev/dri").glob("renderD*"))
    driver = choose_driver(os.environ, DRIVER_FOLDERS, gpu)
    if driver is not None:
        os.environ["VK_ICD_FILENAMES"] = str(driver)


def load_sapien() -> Any:
    """Return the SAPIEN module with its renderer, the driver chosen before.

    Raises
    ------
    RenderingUnavailableError
        SAPIEN, the Vulkan loader or a driver is missing.
    """
    prepare()
    try:
        import sapien  # noqa: PLC0415
        import sapien.render  # noqa: PLC0415
    except (ImportError, OSError) as error:
        raise RenderingUnavailableError(
            f"the renderer cannot be loaded ({error}); pip install -e '.[simulator]'"
        ) from error
    return sapien


def choose_driver(environment: Mapping[str, str], folders: Sequence[Path], gpu: bool) -> Path | None:
    """Return the driver file to set, or None to leave the choice to the loader.

    The loader tries every installed driver. Without a graphics device that only costs time and warnings, so the
    software driver is named; with one, or with a choice made by the user, nothing is changed.
    """
    chosen = environment.get("VK_DRIVER_FILES") or environment.get("VK_ICD_FILENAMES")
    if chosen:
        missing = [name for name in chosen.split(os.pathsep) if not Path(name).is_file()]
        if missing:
            raise RenderingUnavailableError(
                f"VK_ICD_FILENAMES names {missing[0]}, a missing file; unset it, or {INSTALL}"
            )
        return None
    installed = [path for folder in folders for path in sorted(folder.glob("*.json"))]
    if gpu and installed:
        return None
    software = [path for path in installed if path.match("lvp_icd*.json")]
    if not software:
        raise RenderingUnavailableError(f"no Vulkan driver found; {INSTALL}")
    return software[0]

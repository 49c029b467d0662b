"""Version of this program."""

from importlib.metadata import PackageNotFoundError, version


def program_version() -> str:
    """Return the installed version of this program, or "unknown"."""
    try:
        return version("smal")
    except PackageNotFoundError:
        return "unknown"

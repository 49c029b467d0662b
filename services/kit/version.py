"""Which version of this program runs."""

from importlib.metadata import PackageNotFoundError, version


def program_version() -> str:
    """Return the version of this program; "unknown" where it runs without having been installed."""
    try:
        return version("smal")
    except PackageNotFoundError:
        return "unknown"

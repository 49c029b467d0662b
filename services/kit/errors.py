"""Errors that end a command: one line, and an exit status that scripts can rely on."""

from __future__ import annotations


class UsageError(Exception):
    """The command was used wrongly; exit status 2."""


class JobError(Exception):
    """The command was right, the job failed; exit status 1."""


def describe_os_error(error: OSError) -> str:
    """Say in one line what the system refused, and of which file."""
    reason = error.strerror or str(error) or type(error).__name__
    return reason if error.filename is None else f"{error.filename}: {reason}"

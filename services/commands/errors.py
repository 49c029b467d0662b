"""Errors that end a command: one line, and an exit status that scripts can rely on."""

from __future__ import annotations


class UsageError(Exception):
    """The command was used wrongly; exit status 2."""


class JobError(Exception):
    """The command was right, the job failed; exit status 1."""

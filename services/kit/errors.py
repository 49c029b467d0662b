"""Errors that end a command or a service: one line, and an exit status that scripts can rely on."""


class UsageError(Exception):
    """The command was used wrongly; exit status 2."""


class JobError(Exception):
    """What was asked for cannot be done; the text says why in one line. Exit status 1."""


def describe_os_error(error: OSError) -> str:
    """Say in one line what the system refused, and of which file."""
    reason = error.strerror or str(error) or type(error).__name__
    return reason if error.filename is None else f"{error.filename}: {reason}"

"""Where the page is, and who may open it: checked before anything is served."""

import socket
from pathlib import Path
from typing import Annotated, Final, NamedTuple

from pydantic import Field

from services.kit.credentials import others_reach, secret
from services.kit.node import ServiceError
from services.kit.root import RootSettings

_TOKEN_LETTERS: Final = 16  # Letters of a token, at least.


class ConsoleSettings(RootSettings):
    """Where the page is, and who may open it."""

    console: Annotated[str, Field(pattern=r"^[^\s/:]+:\d{1,5}$")] = "127.0.0.1:8080"
    """Where the page is, HOST:PORT; a host that other machines reach needs the three settings that follow."""
    console_cert: Path | None = None
    """Certificate of the page's host, with those that sign it; browsers have to know their authority."""
    console_key: Path | None = None
    """Its key."""
    console_token: Path | None = None
    """File with the word, 16 letters or more, that whoever opens the page has to know: https://HOST:PORT/?token=WORD."""
    insecure: bool = False
    """Listen where other machines reach it, and let everybody in: where something else sees to that, as in a container
    whose port is this machine's."""


class ListenAddress(NamedTuple):
    """Where to serve the page: a listening socket, its address, and the word that a browser has to know, if any."""

    socket: socket.socket
    address: str
    token: str | None


def listen(settings: ConsoleSettings) -> ListenAddress:
    """Listen where the settings say; ServiceError where that cannot be, BusError when others can read the secrets."""
    host, _, port = settings.console.rpartition(":")
    token = _token(settings, host)
    try:
        place = socket.create_server((host, int(port)))
    except (OSError, OverflowError) as error:
        reason = error.strerror if isinstance(error, OSError) else "no such port"
        raise ServiceError(
            f"cannot listen on {settings.console}: {reason}; try another --console HOST:PORT"
        ) from None
    scheme = "http" if token is None else "https"
    return ListenAddress(place, f"{scheme}://{host}:{place.getsockname()[1]}", token)


def _token(settings: ConsoleSettings, host: str) -> str | None:
    """Return the page's token; None for a page without one. Errors are as in `listen`."""
    given = (settings.console_cert, settings.console_key, settings.console_token)
    if others_reach(host) and not settings.insecure and None in given:
        raise ServiceError(
            f"--console {settings.console}: other machines reach it, so it needs --console-cert, --console-key and "
            "--console-token (or --insecure, which lets everybody drive)"
        )
    if None in given and any(given):
        raise ServiceError("--console-cert, --console-key and --console-token go together")
    for path in (settings.console_cert, settings.console_key):
        if path is not None and not path.is_file():
            raise ServiceError(f"no file {path} for the page's address")
    if settings.console_key is not None:
        secret(settings.console_key)
    token = None if settings.console_token is None else secret(settings.console_token)
    if token is not None and len(token) < _TOKEN_LETTERS:
        raise ServiceError(
            f"{settings.console_token}: a token of {len(token)} letters; at least {_TOKEN_LETTERS}"
        )
    return token

"""Address and access settings of the console, checked before it serves."""

import socket
from pathlib import Path
from typing import Annotated, Final, NamedTuple

from pydantic import Field

from services.kit.credentials import others_reach, secret
from services.kit.node import ServiceError
from services.kit.root import RootSettings

_TOKEN_LETTERS: Final = 16  # Minimum length of a token.


class ConsoleSettings(RootSettings):
    """Address and access settings of the console."""

    console: Annotated[str, Field(pattern=r"^[^\s/:]+:\d{1,5}$")] = "127.0.0.1:8080"
    """Address of the page, HOST:PORT; a host that other machines can reach requires the next three
    settings
    """
    console_cert: Path | None = None
    """Certificate chain of the page's host, from an authority that browsers trust"""
    console_key: Path | None = None
    """Private key of the certificate"""
    console_token: Path | None = None
    """File with a token of at least 16 letters, required to open https://HOST:PORT/?token=WORD"""
    insecure: bool = False
    """Serve other machines without access control, for example in a container whose port is local
    to this machine
    """


class ListenAddress(NamedTuple):
    """A listening socket, its address, and the token that browsers need, if any."""

    socket: socket.socket
    address: str
    token: str | None


def listen(settings: ConsoleSettings) -> ListenAddress:
    """Open the listening socket.

    Raises
    ------
    ServiceError
        The settings are invalid, or the address is unavailable.
    BusError
        Other users can read the secrets.
    """
    host, _, port = settings.console.rpartition(":")
    token = _token(settings, host)
    try:
        place = socket.create_server((host, int(port)))
    except (OSError, OverflowError) as error:
        reason = error.strerror if isinstance(error, OSError) else "invalid port"
        raise ServiceError(
            f"cannot listen on {settings.console}: {reason}; try another --console HOST:PORT"
        ) from None
    scheme = "http" if token is None else "https"
    return ListenAddress(place, f"{scheme}://{host}:{place.getsockname()[1]}", token)


def _token(settings: ConsoleSettings, host: str) -> str | None:
    """Return the token of the page, or None; raises the errors of `listen`."""
    given = (settings.console_cert, settings.console_key, settings.console_token)
    if others_reach(host) and not settings.insecure and None in given:
        raise ServiceError(
            f"--console {settings.console}: reachable by other machines; add --console-cert, "
            "--console-key and --console-token (or --insecure, which lets everybody drive)"
        )
    if None in given and any(given):
        raise ServiceError(
            "--console-cert, --console-key and --console-token are required together"
        )
    for path in (settings.console_cert, settings.console_key):
        if path is not None and not path.is_file():
            raise ServiceError(f"{path}: file not found")
    if settings.console_key is not None:
        secret(settings.console_key)
    token = None if settings.console_token is None else secret(settings.console_token)
    if token is not None and len(token) < _TOKEN_LETTERS:
        raise ServiceError(
            f"{settings.console_token}: token too short ({len(token)} letters < minimum "
            f"{_TOKEN_LETTERS})"
        )
    return token

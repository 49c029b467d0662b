"""Where the page is, and who may open it: checked before anything is served."""

from __future__ import annotations

import socket
from typing import Final, NamedTuple

from services.console.config import ConsoleSettings
from services.kit.credentials import others_reach, secret
from services.kit.node import ServiceError

#: Letters of a token, at least.
_TOKEN_LETTERS: Final = 16


class Place(NamedTuple):
    """Where to serve the page.

    Attributes
    ----------
    socket
        It listens.
    address
        As a browser is told it.
    token
        The word that a browser has to know; None where the page is for this machine alone.
    """

    socket: socket.socket
    address: str
    token: str | None


def listen(settings: ConsoleSettings) -> Place:
    """Listen where the settings say.

    Raises
    ------
    ServiceError
        When that may not be listened on, or cannot be.
    BusError
        When others can read the token or the key.
    """
    host, _, port = settings.console.rpartition(":")
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
        raise ServiceError(f"{settings.console_token}: a token of {len(token)} letters; at least {_TOKEN_LETTERS}")
    try:
        place = socket.create_server((host, int(port)))
    except (OSError, OverflowError) as error:
        reason = error.strerror if isinstance(error, OSError) else "no such port"
        raise ServiceError(f"cannot listen on {settings.console}: {reason}; try another --console HOST:PORT") from None
    return Place(place, f"{'http' if token is None else 'https'}://{host}:{place.getsockname()[1]}", token)

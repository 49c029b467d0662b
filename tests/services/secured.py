"""A router with certificates, and raw sessions of each role."""

import json
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Final

import zenoh

from services.cli import certificates
from services.kit.bus import Router
from services.kit.credentials import Credentials, credentials_in
from services.kit.zenoh_session import settings_of

ROBOT: Final = "rescuebot"


def make_keys(folder: Path, days: float = certificates.DAYS, robot: str = ROBOT) -> Path:
    """Make the certificates of every role."""
    certificates.begin(folder, robot)
    certificates.issue(folder, certificates.HOSTS, days)
    return folder


def open_session(
    endpoint: str,
    credentials: Credentials,
    more: dict[str, object] | None = None,
    mode: str = "client",
) -> zenoh.Session:
    """Open a session as a foreign program can: with our settings, and any others."""
    config = zenoh.Config()
    for key, value in (
        settings_of("client", endpoint, credentials) | {"mode": mode} | (more or {})
    ).items():
        config.insert_json5(key, json.dumps(value))
    return zenoh.open(config)


@contextmanager
def secured_router(endpoint: str, keys: Path) -> Iterator[zenoh.Session]:
    """Run a router; gives its own session, which no rule holds back."""
    credentials = credentials_in(keys, "router")
    with closing(Router(endpoint, credentials, ROBOT)) as router:
        yield router._session

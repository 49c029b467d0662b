"""Certificates by which processes and routers authenticate each other (mutual TLS)."""

import ipaddress
import os
import socket
import ssl
import stat
from pathlib import Path
from typing import Final, NamedTuple

from services.kit.wire import BusError

#: Files in the folder of `smal secure init`: `CA_FILE` and, for each role, its name with these
#: suffixes.
CA_FILE: Final = "ca.pem"
CERTIFICATE_SUFFIX: Final = ".pem"
KEY_SUFFIX: Final = ".key"
#: Role of Dask's scheduler, workers and clients, who accept no other certificate. It permits
#: arbitrary code, unlike any role of a robot's bus.
ENGINE: Final = "engine"

#: Timeout of a handshake: a router with an expired certificate is busy with its clients for 1.5 s.
HANDSHAKE_S: Final = 5.0
REFUSAL_S: Final = 1.0  # Time for the router's refusal after the handshake.


class Certificate(NamedTuple):
    """Certificate, key and certificate authority, as PEM files."""

    ca: Path
    certificate: Path
    key: Path


# None on an open bus.
Credentials = Certificate | None


def credentials_in(folder: Path, role: str) -> Certificate:
    """Return a role's certificate; BusError if it is missing or its key is not private."""
    return certificate_of(
        folder / CA_FILE, folder / f"{role}{CERTIFICATE_SUFFIX}", folder / f"{role}{KEY_SUFFIX}"
    )


def certificate_of(ca: Path, certificate: Path, key: Path) -> Certificate:
    """Check that the files exist and the key is private (BusError otherwise)."""
    for path in (ca, certificate):
        if not path.is_file():
            raise BusError(f"certificate {path} not found; create a folder by `smal secure init`")
    secret(key)
    return Certificate(ca, certificate, key)


def encrypted(endpoint: str) -> bool:
    """Return whether an address uses encrypted connections."""
    return endpoint.startswith("tls/")


def how_secure(credentials: Credentials, *hosts: str) -> str:
    """Describe the access to routers that listen on the given hosts."""
    if credentials is not None:
        return "for holders of a certificate, encrypted"
    return (
        "for this machine only"
        if hosts and not any(map(others_reach, hosts))
        else "for anyone who can reach it"
    )


def why_refused(certificate: Certificate, host: str, port: int) -> str | None:
    """Return which certificate a handshake refuses and why, or None."""
    where = f"tls/{host}:{port}"
    try:
        context = ssl.create_default_context(cafile=certificate.ca)
        context.load_cert_chain(certificate.certificate, certificate.key)
    except ssl.SSLError:
        return (
            f"cannot use {certificate.certificate} with its key and {certificate.ca}; "
            "for the reason run `smal secure check`"
        )
    try:
        with (
            socket.create_connection((host, port), HANDSHAKE_S) as plain,
            context.wrap_socket(plain, server_hostname=host) as encrypted_socket,
        ):
            # A refusal arrives after the handshake; a Zenoh router otherwise waits for the client.
            encrypted_socket.settimeout(REFUSAL_S)
            encrypted_socket.recv(1)
    except ssl.SSLCertVerificationError as error:
        more = (
            f"; `smal secure renew DIR --host {host}` adds a name"
            if "mismatch" in error.verify_message
            else ""
        )
        return f"the certificate that {where} shows is refused: {error.verify_message.rstrip('.')}{more}"
    except ssl.SSLError as error:
        _, alert, reason = (error.reason or "").partition("ALERT_")
        return (
            f"{where} refuses {certificate.certificate}: {reason.lower().replace('_', ' ')}"
            if alert
            else None
        )
    except OSError:
        return None
    return None


def others_reach(host: str) -> bool:
    """Return whether other machines can reach a host by any of its addresses."""
    try:
        found = {str(one[4][0]).partition("%")[0] for one in socket.getaddrinfo(host, None)}
    except OSError:
        return False
    return not all(ipaddress.ip_address(address).is_loopback for address in found)


def secret(path: Path) -> str:
    """Read a private file.

    Files of root that are readable by one of this process's groups count as private: Kubernetes
    mounts a pod's secrets so.

    Raises
    ------
    BusError
        If the file cannot be read, or others can read it.
    """
    try:
        status = path.stat()
        ours = status.st_gid in {os.getegid(), *os.getgroups()}
        given = stat.S_IRGRP if ours and status.st_uid == 0 != os.geteuid() else 0
        if status.st_mode & (stat.S_IRWXG | stat.S_IRWXO) & ~given:
            raise BusError(f"{path} can be read by others; run: chmod 600 {path}")
        return path.read_text().strip()
    except OSError as error:
        raise BusError(f"cannot read {path}: {error.strerror or error}") from None

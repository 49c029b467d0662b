"""How a process shows the router who it is: by a certificate, as the router does; the connection is encrypted."""

import ipaddress
import os
import socket
import ssl
import stat
from pathlib import Path
from typing import Final, NamedTuple

from services.kit.wire import BusError

#: Files of a folder that `smal secure init` makes: `CA_FILE`, and for each role its name with one of these ends.
CA_FILE: Final = "ca.pem"
CERTIFICATE_SUFFIX: Final = ".pem"
KEY_SUFFIX: Final = ".key"
#: Of a scheduler of Dask, its workers and who computes there: each shows this one, and takes no other. Its holder can
#: run anything at them, which no role of a robot's bus may.
ENGINE: Final = "engine"

#: How long a handshake may take: a router whose certificate has expired is busy with its clients for 1.5 s.
HANDSHAKE_S: Final = 5.0
REFUSAL_S: Final = 1.0  # How long after it the router may take to refuse us.


class Certificate(NamedTuple):
    """A certificate, its key, and by whose signature others are known; all are PEM files."""

    ca: Path
    certificate: Path
    key: Path


Credentials = Certificate | None  # None of whoever goes to an open bus.


def credentials_in(folder: Path, role: str) -> Certificate:
    """Return a folder's certificate for a role; BusError where it has none, or others can read its key."""
    return certificate_of(
        folder / CA_FILE, folder / f"{role}{CERTIFICATE_SUFFIX}", folder / f"{role}{KEY_SUFFIX}"
    )


def certificate_of(ca: Path, certificate: Path, key: Path) -> Certificate:
    """Return a certificate whose files are there. Raises BusError when one is not, or others can read the key."""
    for path in (ca, certificate):
        if not path.is_file():
            raise BusError(f"no certificate {path}; `smal secure init` makes a folder of them")
    secret(key)
    return Certificate(ca, certificate, key)


def encrypted(endpoint: str) -> bool:
    """Whether an address is one of encrypted connections."""
    return endpoint.startswith("tls/")


def how_secure(credentials: Credentials, *hosts: str) -> str:
    """Say who gets in at routers, which listen on some hosts; a client does not know on which others as well."""
    if credentials is not None:
        return "for holders of a certificate, encrypted"
    return (
        "for whoever is on this machine"
        if hosts and not any(map(others_reach, hosts))
        else "for whoever reaches it"
    )


def why_refused(certificate: Certificate, host: str, port: int) -> str | None:
    """Shake hands with a router, to say whose certificate is refused, and why; None where none is."""
    where = f"tls/{host}:{port}"
    try:
        context = ssl.create_default_context(cafile=certificate.ca)
        context.load_cert_chain(certificate.certificate, certificate.key)
    except ssl.SSLError:
        return f"cannot use {certificate.certificate} with its key and {certificate.ca}; `smal secure check` says why"
    try:
        with (
            socket.create_connection((host, port), HANDSHAKE_S) as plain,
            context.wrap_socket(plain, server_hostname=host) as encrypted_socket,
        ):
            # Who refuses us says so after the handshake. Zenoh's router waits for us to speak.
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
    """Whether another machine might reach a host, by any of its addresses; none does where it has no address."""
    try:
        found = {str(one[4][0]).partition("%")[0] for one in socket.getaddrinfo(host, None)}
    except OSError:
        return False
    return not all(ipaddress.ip_address(address).is_loopback for address in found)


def secret(path: Path) -> str:
    """Read a file that is nobody else's business. Raises BusError when it cannot be read, or others can read it.

    What root gives to a group of ours to read, as Kubernetes gives its secrets to a pod, is for us.
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

"""Certificates of a robot's bus, one for each role, signed by the robot's own authority."""

import ipaddress
import os
import re
import secrets
from collections.abc import Iterable, Iterator
from contextlib import suppress
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Final, NamedTuple

from cryptography import x509
from cryptography.exceptions import InvalidSignature, UnsupportedAlgorithm
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.asymmetric.types import PrivateKeyTypes
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from schemas.codec import printable
from services.kit.credentials import CA_FILE, CERTIFICATE_SUFFIX, ENGINE, KEY_SUFFIX
from services.kit.errors import UsageError
from services.table import roles

CA_KEY_FILE: Final = "ca.key"
# An authority must outlive its certificates; ten years exceed a robot's life.
CA_DAYS: Final = 3650.0
DAYS: Final = 365.0  # A stolen certificate expires within a year.
SKEW: Final = timedelta(minutes=5)  # Clock difference between two machines.
SOON: Final = timedelta(days=30)  # `check` reports certificates that expire within this time.
HOSTS: Final = (
    "localhost",
    "127.0.0.1",
    "::1",
    "router",
)  # Names by which the router's own machine and compose reach the router.
ROUTER: Final = "router"
#: Name of a host: labels of at most 63 letters, digits and hyphens (RFC 1123); other alphabets as
#: ``xn--``.
_LABEL: Final = r"[A-Za-z0-9](?:[A-Za-z0-9_-]{0,61}[A-Za-z0-9])?"
_HOST_PATTERN: Final = rf"{_LABEL}(?:\.{_LABEL})*"
_PEM: Final = serialization.Encoding.PEM


class Authority(NamedTuple):
    """The certificate authority that signs."""

    certificate: x509.Certificate
    key: ec.EllipticCurvePrivateKey


class Finding(NamedTuple):
    """The result of `check` for one file."""

    file: str
    ok: bool
    text: str


def begin(folder: Path, robot: str) -> None:
    """Create a new authority and keep the existing ones as trusted."""
    key = ec.generate_private_key(ec.SECP256R1())
    # A name of its own: of two authorities with one name, TLS tries only one.
    name = f"smal {robot} {secrets.token_hex(4)}"
    certificate = _signed(
        name, _name(name), key.public_key(), key, CA_DAYS, x509.BasicConstraints(True, 0), _CA_USAGE
    )
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    known = (folder / CA_FILE).read_bytes() if (folder / CA_FILE).exists() else b""
    # Trusted before it signs: after an interruption the authority still has its key.
    _write(folder / CA_FILE, certificate.public_bytes(_PEM) + known, mode=0o644)
    _write(folder / CA_KEY_FILE, _pem_of(key))


def issue(folder: Path, hosts: Iterable[str], days: float = DAYS) -> None:
    """Issue new certificates for every role and the engine."""
    authority = read_authority(folder)
    for role in (*roles(), ENGINE):
        key = ec.generate_private_key(ec.SECP256R1())
        if role == ENGINE:
            nobodys = x509.BasicConstraints(False, None)
            certificate = _signed(role, _name(role), key.public_key(), key, days, nobodys)
        else:
            certificate = certificate_of(
                authority, role, key.public_key(), hosts if role == ROUTER else (), days
            )
        _write(folder / f"{role}{KEY_SUFFIX}", _pem_of(key))
        _write(folder / f"{role}{CERTIFICATE_SUFFIX}", certificate.public_bytes(_PEM), mode=0o644)


def certificate_of(
    authority: Authority,
    role: str,
    key: ec.EllipticCurvePublicKey,
    hosts: Iterable[str],
    days: float,
) -> x509.Certificate:
    """Issue the certificate of a role; with hosts, it is valid for a router as well."""
    names = dict.fromkeys([x509.DNSName(role), *map(_general_name, hosts)])
    uses = [
        ExtendedKeyUsageOID.CLIENT_AUTH,
        *([ExtendedKeyUsageOID.SERVER_AUTH] if len(names) > 1 else []),
    ]
    extensions = (
        x509.BasicConstraints(False, None),
        x509.ExtendedKeyUsage(uses),
        x509.SubjectAlternativeName(names),
    )
    return _signed(role, authority.certificate.subject, key, authority.key, days, *extensions)


def check_host(host: str) -> str:
    """Check the name or address of a host and return it."""
    try:
        ipaddress.ip_address(host)
    except ValueError:
        if re.fullmatch(_HOST_PATTERN, host) is None:
            raise UsageError(
                f"--host {printable(host)!r}: invalid: neither a host name in ASCII nor an IP "
                "address"
            ) from None
    return host


def names_of_router(folder: Path) -> list[str]:
    """Return the host names in the router's certificate, or () without a certificate."""
    path = folder / f"{ROUTER}{CERTIFICATE_SUFFIX}"
    if not path.exists():
        return []
    try:
        certificate = x509.load_pem_x509_certificate(path.read_bytes())
        found = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName)
    except (OSError, ValueError, x509.ExtensionNotFound):
        raise UsageError(
            f"{path}: not a certificate; delete it and give the names with --host"
        ) from None
    return [str(name.value) for name in found.value]


def robot_of(authority: Authority) -> str:
    """Return the robot that an authority was created for."""
    name = authority.certificate.subject.rfc4514_string()
    found = re.fullmatch(r"CN=smal (\S+) \w+", name)
    if found is None:
        raise UsageError(f"{CA_FILE}: belongs to {name}; not created by `smal secure init`")
    return found[1]


def retire(folder: Path) -> int:
    """Remove all authorities but the newest and return their number.

    Raises
    ------
    UsageError
        If a certificate is signed by an authority to remove.
    """
    newest = read_authority(folder).certificate
    for one in _of_roles(folder, [newest]):
        if not one.ok:
            raise UsageError(f"{folder / one.file}: {one.text}; run `smal secure renew` first")
    others = len(_authorities(folder)) - 1
    _write(folder / CA_FILE, newest.public_bytes(_PEM), mode=0o644)
    return others


def read_authority(folder: Path) -> Authority:
    """Read the authority whose key is in the folder."""
    path = folder / CA_KEY_FILE
    authorities = _authorities(folder)
    try:
        key = _read_key(path)
    except (OSError, ValueError) as error:
        raise UsageError(f"{path}: cannot sign: {_why(error)}") from None
    for authority in authorities:
        if (
            isinstance(key, ec.EllipticCurvePrivateKey)
            and key.public_key() == authority.public_key()
        ):
            return Authority(authority, key)
    raise UsageError(f"{path}: key of no authority in {folder / CA_FILE}")


def require(folder: Path, needed: Iterable[str]) -> None:
    """Check the authorities and the certificates of some roles; raise UsageError if one is invalid."""
    files = {CA_FILE, *(f"{role}{CERTIFICATE_SUFFIX}" for role in needed)}
    for one in check(folder):
        if one.file in files and not one.ok:
            raise UsageError(f"{folder / one.file}: {one.text}")


def check(folder: Path) -> Iterator[Finding]:
    """Check every certificate in a folder."""
    authorities = _authorities(folder)
    for k, authority in enumerate(authorities):
        name = CA_FILE if k == 0 else f"{CA_FILE}, older"
        yield Finding(name, *_validity(authority, "rotate"))
    yield from _of_roles(folder, authorities)
    path = folder / CA_KEY_FILE
    if path.exists() and (open_to := _open_to_others(path)):
        yield Finding(path.name, ok=False, text=open_to)


def _of_roles(folder: Path, authorities: list[x509.Certificate]) -> Iterator[Finding]:
    for role in (*roles(), ENGINE):
        path = folder / f"{role}{CERTIFICATE_SUFFIX}"
        if path.exists():
            yield Finding(path.name, *_verdict(path, role, authorities))


def _verdict(path: Path, role: str, authorities: list[x509.Certificate]) -> tuple[bool, str]:
    key_path = path.with_suffix(KEY_SUFFIX)
    try:
        certificate = x509.load_pem_x509_certificate(path.read_bytes())
        key = _read_key(key_path)
    except (OSError, ValueError) as error:
        return False, f"certificate or key cannot be read: {_why(error)}"
    names = [
        str(one.value) for one in certificate.subject.get_attributes_for_oid(NameOID.COMMON_NAME)
    ]
    open_to = _open_to_others(key_path)
    is_router = _is_router(certificate)
    signers = [certificate] if role == ENGINE else authorities
    faults = (
        (
            names != [role],
            f"issued for {', '.join(names) or 'no role'}, not for {role}",
        ),
        (
            not any(_has_signed(one, certificate) for one in signers),
            f"not signed by an authority in {CA_FILE}",
        ),
        (key.public_key() != certificate.public_key(), "key belongs to another certificate"),
        (bool(open_to), f"key {open_to}"),
        (is_router and role != ROUTER, "invalid: lets its holder act as a router"),
        (role == ROUTER and not is_router, "invalid: does not let its holder act as a router"),
    )
    return next(((False, text) for wrong, text in faults if wrong), _validity(certificate))


def _is_router(certificate: x509.Certificate) -> bool:
    with suppress(x509.ExtensionNotFound):
        uses = certificate.extensions.get_extension_for_class(x509.ExtendedKeyUsage).value
        return ExtendedKeyUsageOID.SERVER_AUTH in uses
    return False


def _open_to_others(secret: Path) -> str:
    return (
        f"readable by other users; run: chmod 600 {secret}" if secret.stat().st_mode & 0o077 else ""
    )


def _validity(certificate: x509.Certificate, remedy: str = "renew") -> tuple[bool, str]:
    now = datetime.now(UTC)
    end = certificate.not_valid_after_utc
    if now > end:
        return False, f"expired on {end:%Y-%m-%d %H:%M} UTC; run: smal secure {remedy}"
    if now < certificate.not_valid_before_utc:
        return (
            False,
            f"not valid before {certificate.not_valid_before_utc:%Y-%m-%d %H:%M} UTC; check "
            "this machine's clock",
        )
    return True, f"valid until {end:%Y-%m-%d}" + (
        f" (soon); run: smal secure {remedy}" if end - now < SOON else ""
    )


def _has_signed(authority: x509.Certificate, certificate: x509.Certificate) -> bool:
    with suppress(ValueError, TypeError, InvalidSignature):
        certificate.verify_directly_issued_by(authority)
        return True
    return False


#: An authority only signs.
_CA_USAGE: Final = x509.KeyUsage(
    key_cert_sign=True, crl_sign=True, digital_signature=False, content_commitment=False, key_encipherment=False,
    data_encipherment=False, key_agreement=False, encipher_only=False, decipher_only=False,
)  # fmt: skip


def _signed(
    name: str,
    issuer: x509.Name,
    key: ec.EllipticCurvePublicKey,
    by: ec.EllipticCurvePrivateKey,
    days: float,
    *extensions: x509.ExtensionType,
) -> x509.Certificate:
    now = datetime.now(UTC)
    builder = (
        x509.CertificateBuilder().subject_name(_name(name)).issuer_name(issuer).public_key(key)
    )
    builder = builder.serial_number(x509.random_serial_number())
    builder = builder.not_valid_before(now - SKEW).not_valid_after(now + timedelta(days=days))
    for one in extensions:
        builder = builder.add_extension(
            one, critical=not isinstance(one, x509.SubjectAlternativeName)
        )
    return builder.sign(by, hashes.SHA256())


def _authorities(folder: Path) -> list[x509.Certificate]:
    path = folder / CA_FILE
    try:
        return x509.load_pem_x509_certificates(path.read_bytes())
    except OSError as error:
        raise UsageError(f"{path}: {_why(error)}; create it with `smal secure init`") from None
    except ValueError:
        raise UsageError(f"{path}: not a certificate") from None


def _why(error: OSError | ValueError) -> str:
    return error.strerror or str(error) if isinstance(error, OSError) else str(error)


def _name(common: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, common)])


def _general_name(host: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(host))
    except ValueError:
        return x509.DNSName(host)


def _read_key(path: Path) -> PrivateKeyTypes:
    """Read an unencrypted private key."""
    try:
        return serialization.load_pem_private_key(path.read_bytes(), None)
    except (TypeError, ValueError, UnsupportedAlgorithm):
        raise ValueError("not a private key, or encrypted") from None


def _pem_of(key: ec.EllipticCurvePrivateKey) -> bytes:
    return key.private_bytes(_PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption())


def _write(path: Path, content: bytes, mode: int = 0o600) -> None:
    """Replace a file atomically; a secret is readable by its owner only from the start."""
    new = path.with_name(f".{path.name}.new")
    new.unlink(missing_ok=True)
    try:
        with os.fdopen(os.open(new, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode), "wb") as file:
            file.write(content)
        new.replace(path)
    except OSError:
        new.unlink(missing_ok=True)
        raise

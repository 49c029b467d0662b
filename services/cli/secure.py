"""``smal secure``: permissions on a robot's bus by certificates."""

import json
import socket
from pathlib import Path
from typing import Annotated, Final

import typer
from typer import Argument, Option

from services.cli import certificates, options, outputs
from services.cli.certificates import DAYS, HOSTS
from services.cli.grouping import STYLE
from services.kit.bus import zenohd_configuration
from services.kit.credentials import Certificate
from services.kit.errors import UsageError
from services.kit.process import EXIT_FAILED
from services.table import roles

#: Paths at which deploy/secure.yml mounts the certificate in Eclipse's router.
ZENOHD_SEES: Final = Certificate(
    *(Path("/run/secrets") / name for name in ("ca.pem", "cert.pem", "key.pem"))
)
ZENOHD_FILE: Final = "zenohd.json5"
Folder = Annotated[Path, Argument(help="Folder of the certificates.", metavar="DIR")]
Hosts = Annotated[
    list[str] | None, Option("--host", help="Name or address of the router; repeatable.")
]
Days = Annotated[float, Option(min=0, max=3650, help="Validity of the certificates, days.")]

app = typer.Typer(
    help="Create and check the certificates that define permissions on a robot's "
    "bus.\n\nExample: smal secure init keys, and then: smal up --secure keys",
    **STYLE,
)


@app.command("init")
def init(
    folder: Folder,
    robot: options.Robot = options.DEFAULT_ROBOT,
    host: Hosts = None,
    days: Days = DAYS,
    robots: options.Robots = 1,
) -> None:
    """Create a certificate authority, a certificate for every role, and rules for Eclipse's router.

    The engine's certificate is for Dask schedulers and their workers only (`smal evaluate
    --scheduler`). Copy to each machine ca.pem and the certificate and key of its role. Keep ca.key
    away from robots: its holder can take any role.

    Example: smal secure init keys --host robot.example
    """
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise UsageError(f"{folder}: already exists; `smal secure renew` creates new certificates")
    hosts = _hosts(host)
    names = options.fleet_of(robot, robots)
    settings = zenohd_configuration("tls/0.0.0.0:7447", names, ZENOHD_SEES)
    with outputs.new_folder(folder, "DIR") as made:
        made.chmod(0o700)
        certificates.begin(made, robot)
        certificates.issue(made, hosts, days)
        (made / ZENOHD_FILE).write_text(json.dumps(settings, indent=2) + "\n")
        (made / ".gitignore").write_text("*\n")  # A folder in a checkout must not be committed.
    typer.echo(f"certificates of {', '.join(roles())} in {folder}; next: smal up --secure {folder}")


@app.command("check")
def check(folder: Folder) -> None:
    """Check every certificate in a folder.

    The exit status is 1 if a certificate is expired or invalid.

    Example: smal secure check keys
    """
    findings = list(certificates.check(folder))
    for one in findings:
        typer.echo(f"{'ok' if one.ok else 'problem':8} {one.file:16} {one.text}")
    if not all(one.ok for one in findings):
        raise typer.Exit(EXIT_FAILED)


@app.command("renew")
def renew(folder: Folder, host: Hosts = None, days: Days = DAYS) -> None:
    """Create new certificates for every role, signed by the newest authority.

    The router's certificate keeps its host names; --host adds more. A process uses its new
    certificate at the next connection, the router at its next start.

    Example: smal secure renew keys
    """
    certificates.issue(folder, (*_hosts(host), *certificates.names_of_router(folder)), days)
    typer.echo(f"new certificates in {folder}; restart the router to use its new certificate")


@app.command("rotate")
def rotate(folder: Folder) -> None:
    """Create a new authority beside the existing one; both are trusted.

    Then, distributing the new files before each restart: restart the router, `smal secure renew`,
    restart the router, `smal secure retire`, restart the router. The robot stands for about a
    second
    during a restart and continues. If an operator is present, the operator must arm it again.

    Example: smal secure rotate keys
    """
    certificates.begin(folder, certificates.robot_of(certificates.read_authority(folder)))
    typer.echo(
        f"{folder} trusts the old authority and a new one; restart the router, then run: smal "
        "secure renew"
    )


@app.command("retire")
def retire(folder: Folder) -> None:
    """Remove every authority but the newest, and with them trust in their certificates.

    Example: smal secure retire keys
    """
    if certificates.retire(folder):
        typer.echo(f"{folder} trusts the newest authority alone; restart the router")
    else:
        typer.echo(f"{folder} has one authority; no change")


def _hosts(more: list[str] | None) -> tuple[str, ...]:
    return (*HOSTS, socket.gethostname(), *map(certificates.check_host, more or ()))

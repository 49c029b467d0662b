"""``smal secure``: who may do what on a robot's bus, by certificates."""

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

#: What deploy/secure.yml shows Eclipse's router.
ZENOHD_SEES: Final = Certificate(
    *(Path("/run/secrets") / name for name in ("ca.pem", "cert.pem", "key.pem"))
)
ZENOHD_FILE: Final = "zenohd.json5"
Folder = Annotated[Path, Argument(help="Folder of the certificates.", metavar="DIR")]
Hosts = Annotated[
    list[str] | None, Option("--host", help="Name or address of the router; may be repeated.")
]
Days = Annotated[float, Option(min=0, max=3650, help="How long the certificates are valid.")]

app = typer.Typer(
    help="Make and check the certificates by which the router knows who may do what.\n\n"
    "Example: smal secure init keys, and then: smal up --secure keys",
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
    """Make a certificate authority, a certificate of every role and of the engine, and the rules of Eclipse's router.

    The engine's is for schedulers of Dask and their workers (`smal evaluate --scheduler`), and for nothing else. Give
    each machine ca.pem and the certificate and key of what runs there, and keep ca.key where no robot is: whoever has
    it can be anybody.

    Example: smal secure init keys --host robot.example
    """
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise UsageError(f"{folder}: is there already; `smal secure renew` makes new certificates")
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
    """Look at every certificate in a folder; exit status 1 where one is expired, or not what it should be.

    Example: smal secure check keys
    """
    findings = list(certificates.check(folder))
    for one in findings:
        typer.echo(f"{'ok' if one.ok else 'problem':8} {one.file:16} {one.text}")
    if not all(one.ok for one in findings):
        raise typer.Exit(EXIT_FAILED)


@app.command("renew")
def renew(folder: Folder, host: Hosts = None, days: Days = DAYS) -> None:
    """Make new certificates of every role, signed by the newest authority; the router's for the same hosts, and more.

    The router's keeps the names that it has; --host adds more. A process shows its new one when it connects again; the
    router, when it is started again.

    Example: smal secure renew keys
    """
    certificates.issue(folder, (*_hosts(host), *certificates.names_of_router(folder)), days)
    typer.echo(f"new certificates in {folder}; start the router again, so that it shows its own")


@app.command("rotate")
def rotate(folder: Folder) -> None:
    """Make a new authority beside the one there is, so that the certificates of both are taken.

    Then: start the router again, `smal secure renew`, start the router again, `smal secure retire`, start the router
    again; each time when the new files are where they are used. The robot stands while the router starts, for about a
    second each time, and goes on; with an operator there, who is lost meanwhile, when they arm it again.

    Example: smal secure rotate keys
    """
    certificates.begin(folder, certificates.robot_of(certificates.read_authority(folder)))
    typer.echo(
        f"{folder} knows the old authority and a new one; start the router again, then: smal secure renew"
    )


@app.command("retire")
def retire(folder: Folder) -> None:
    """Forget every authority but the newest: what the others have signed is taken no more.

    Example: smal secure retire keys
    """
    if certificates.retire(folder):
        typer.echo(f"{folder} knows the newest authority alone; start the router again")
    else:
        typer.echo(f"{folder} has one authority; nothing to forget")


def _hosts(more: list[str] | None) -> tuple[str, ...]:
    return (*HOSTS, socket.gethostname(), *map(certificates.check_host, more or ()))

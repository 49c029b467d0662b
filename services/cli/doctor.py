"""``smal doctor``: try everything that SMAL needs of this machine."""

from __future__ import annotations

import json
from dataclasses import asdict

import typer

from services.cli import options
from services.cli.checks import check_disk, check_port, check_python, check_rendering, check_zenoh
from services.kit.process import EXIT_FAILED


def doctor(*, as_json: options.Json = False, reach: options.Reach) -> None:
    """Check rendering, Zenoh, the router's port, Python and disk space; says what to install.

    Example: smal doctor
    """
    results = []
    settings = reach.settings
    for check in (check_python, check_disk, check_zenoh, lambda: check_port(settings), check_rendering):
        results.append(check())
        if not as_json:
            typer.echo(f"{'ok' if results[-1].ok else 'problem':8} {results[-1].name:10} {results[-1].text}")
    if as_json:
        typer.echo(json.dumps([asdict(result) for result in results], indent=2))
    if not all(result.ok for result in results):
        raise typer.Exit(EXIT_FAILED)

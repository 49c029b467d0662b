"""``smal doctor``: try everything that SMAL needs of this machine."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict

import typer

from services.cli.checks import Check, check_disk, check_port, check_python, check_rendering, check_zenoh
from services.cli.options import DEFAULT_ROBOT, Json, Robot, Router, Secure, settings_for
from services.kit.process import EXIT_FAILED


def doctor(as_json: Json = False, robot: Robot = DEFAULT_ROBOT, router: Router = None, secure: Secure = None) -> None:
    """Check rendering, Zenoh, the router's port, Python and disk space; says what to install.

    Example: smal doctor
    """
    checks: tuple[Callable[[], Check], ...] = (
        check_python,
        check_disk,
        check_zenoh,
        lambda: check_port(settings_for(robot, router, secure)),
        check_rendering,
    )
    results = []
    for check in checks:
        results.append(check())
        if not as_json:
            typer.echo(_line(results[-1]))
    if as_json:
        typer.echo(json.dumps([asdict(result) for result in results], indent=2))
    if not all(result.ok for result in results):
        raise typer.Exit(EXIT_FAILED)


def _line(check: Check) -> str:
    return f"{'ok' if check.ok else 'problem':8} {check.name:10} {check.text}"

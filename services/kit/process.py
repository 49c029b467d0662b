"""How the process of a service starts, and ends where it cannot."""

import logging
import sys
from collections.abc import Callable
from typing import Final, TypeVar

from pydantic import ValidationError

from schemas.codec import describe
from services.kit.errors import JobError, UsageError
from services.kit.group import Group
from services.kit.node import Node, on_signals
from services.kit.settings import FleetSettings, ServiceSettings

EXIT_FAILED: Final = 1
EXIT_USAGE: Final = 2
S = TypeVar("S", bound=ServiceSettings)
F = TypeVar("F", bound=FleetSettings)


def read_settings(cls: type[S], service: str) -> S:
    """Read settings from flags and environment; exit with status 2 and one line where they are wrong."""
    try:
        return cls(_cli_parse_args=True, _cli_prog_name=f"python -m services.{service}")
    except ValidationError as error:
        sys.stderr.write(f"{service}: {describe(error)}\n")
        raise SystemExit(EXIT_USAGE) from None


def configure_logging(level: str) -> None:
    """Log to standard error, one line an event."""
    logging.basicConfig(
        level=level.upper(), stream=sys.stderr, format="%(asctime)s.%(msecs)03d %(levelname)-7s %(name)s: %(message)s",
        datefmt="%H:%M:%S", force=True,
    )  # fmt: skip


def run_node(name: str, settings: type[S], serve: Callable[[Node, S], None]) -> None:
    """Run a service that is one node, by its settings; it ends on a signal."""

    def run() -> None:
        given = read_settings(settings, name)
        configure_logging(given.log_level)
        with Node(name, given) as node:
            node.stop_on_signals()
            serve(node, given)

    run_service(name, run)


def run_group(name: str, settings: type[F], serve: Callable[[Node, F], None]) -> None:
    """Run an instance of a service that may run any number of times, by its settings; it ends on a signal."""

    def run() -> None:
        given = read_settings(settings, name)
        configure_logging(given.log_level)
        group = Group(name, given, serve)
        on_signals(group.log, group.stop)
        group.run()

    run_service(name, run)


def run_service(name: str, serve: Callable[[], None]) -> None:
    """Run a service's main function; a failure to start is one line and an exit status."""
    try:
        serve()
    except (JobError, UsageError) as error:
        logging.getLogger(name).error("%s", error)  # noqa: TRY400 - one clear line is what an operator needs
        raise SystemExit(EXIT_FAILED if isinstance(error, JobError) else EXIT_USAGE) from None

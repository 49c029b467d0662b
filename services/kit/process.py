"""Start of a service's process, and its end after a failure."""

import logging
import os
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Final, NoReturn, TypeVar

from pydantic import ValidationError

from schemas.codec import describe
from services.kit.ending import service_process
from services.kit.errors import NO_MEMORY, JobError, UsageError, out_of_memory
from services.kit.group import Group
from services.kit.node import Node, on_signals
from services.kit.settings import FleetSettings, ServiceSettings

EXIT_FAILED: Final = 1
EXIT_USAGE: Final = 2
#: Loggers of libraries that catch the exceptions of callbacks.
_CATCHERS: Final = ("zenoh.handlers", "bus", "asyncio", "uvicorn.error")
S = TypeVar("S", bound=ServiceSettings)
F = TypeVar("F", bound=FleetSettings)


def read_settings(cls: type[S], service: str) -> S:
    """Read settings from flags and environment; exit with one line if they are invalid."""
    try:
        return cls(_cli_parse_args=True, _cli_prog_name=f"python -m services.{service}")
    except ValidationError as error:
        sys.stderr.write(f"{service}: {describe(error)}\n")
        raise SystemExit(EXIT_USAGE) from None


def configure_logging(level: str) -> None:
    """Log to standard error, one line per event."""
    logging.basicConfig(
        level=level.upper(), stream=sys.stderr, format="%(asctime)s.%(msecs)03d %(levelname)-7s %(name)s: %(message)s",
        datefmt="%H:%M:%S", force=True,
    )  # fmt: skip


def run_node(name: str, settings: type[S], serve: Callable[[Node, S], None]) -> None:
    """Run a service with a single node until a signal."""

    def run() -> None:
        given = read_settings(settings, name)
        configure_logging(given.log_level)
        with Node(name, given) as node:
            node.stop_on_signals()
            serve(node, given)

    run_service(name, run)


def run_group(name: str, settings: type[F], serve: Callable[[Node, F], None]) -> None:
    """Run an instance of a grouped service until a signal."""

    def run() -> None:
        given = read_settings(settings, name)
        configure_logging(given.log_level)
        group = Group(name, given, serve)
        on_signals(group.log, group.stop)
        group.run()

    run_service(name, run)


def run_service(name: str, serve: Callable[[], None]) -> None:
    """Run a service's main function; a failure ends with one line and an exit status.

    A thread that fails ends the process, and so does a callback that lacks memory. Their work is
    missing from then on, while a new process resumes it.
    """
    try:
        with _ended_by_threads(name), service_process():
            serve()
    except (JobError, UsageError) as error:
        logging.getLogger(name).error("%s", error)  # noqa: TRY400 - one clear line is what an operator needs
        raise SystemExit(EXIT_FAILED if isinstance(error, JobError) else EXIT_USAGE) from None
    except BaseException as error:
        # A panic of Zenoh during the cleanup hides the first error.
        if any(map(out_of_memory, _with_causes(error))):
            _end(name, NO_MEMORY)
        # Zenoh has printed the location, and cannot be closed.
        if type(error).__name__ == "PanicException":
            _end(name, f"{error}; this process ends and must be started again")
        raise


def _with_causes(error: BaseException | None) -> Iterator[BaseException]:
    while error is not None:
        yield error
        error = error.__context__


@contextmanager
def _ended_by_threads(name: str) -> Iterator[None]:
    """End the process when a thread fails, or a callback lacks memory."""
    passes = partial(_passes, name)
    before = threading.excepthook
    threading.excepthook = partial(_end_by_thread, name)
    for catcher in _CATCHERS:
        logging.getLogger(catcher).addFilter(passes)
    try:
        yield
    finally:
        for catcher in _CATCHERS:
            logging.getLogger(catcher).removeFilter(passes)
        threading.excepthook = before


def _end_by_thread(name: str, failed: threading.ExceptHookArgs) -> None:
    error = failed.exc_value
    thread = "a thread" if failed.thread is None else failed.thread.name
    if error is None or out_of_memory(error):
        _end(name, NO_MEMORY)
    _end(name, f"the thread {thread!r} failed; this process ends and must be started again", error)


def _passes(name: str, record: logging.LogRecord) -> bool:
    """End the process if a callback lacks memory; let other errors be logged."""
    error = record.exc_info[1] if record.exc_info else None
    if error is not None and out_of_memory(error):
        _end(name, NO_MEMORY)
    return True


def _end(name: str, why: str, error: BaseException | None = None) -> NoReturn:
    """End the process at once, as by SIGKILL: a cleanup needs memory and live threads."""
    try:
        logging.getLogger(name).critical(why, exc_info=error)
    finally:
        os._exit(EXIT_FAILED)

"""Parallel work on several processes: Dask on this machine, or at a running scheduler."""

import concurrent.futures
import hashlib
import logging
import os
import signal
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from functools import cache, partial
from importlib.metadata import version
from importlib.util import find_spec
from itertools import islice
from multiprocessing.resource_tracker import ensure_running
from operator import length_hint
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Final, Self, TypeVar

from tqdm import tqdm

from services.kit.credentials import (
    CERTIFICATE_SUFFIX,
    ENGINE,
    KEY_SUFFIX,
    certificate_of,
    others_reach,
)
from services.kit.errors import JobError, UsageError
from smal.features.extraction import in_parallel

if TYPE_CHECKING:
    from distributed import Client, Future, LocalCluster

_REACHED_S: Final = 10.0  # Timeout for a connection to a scheduler.
#: Timeout for a worker, also after a crash of all. A worker starts in 2 s, on a very busy machine
#: in 50 s.
_WORKER_S: Final = 120.0
_LOOK_S: Final = 1.0  # Period of the check for workers.
# Maximum batch: an image takes 5 ms or more, the engine 5 ms per task.
_BATCH: Final = 16
_AHEAD: Final = 4  # Tasks in progress for each thread of a worker.
_TRIES = 3  # A task fails after this number of killed workers.
#: Setup of the workers on this machine. Ctrl-C is left to the parent process, which also reports
#: damaged images (`quiet_opencv`). OpenCV uses one thread, because each core has a worker.
_PRELOAD: Final = """import signal, cv2
signal.signal(signal.SIGINT, signal.SIG_IGN)
cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
cv2.setNumThreads(1)
"""
# Folder of our packages: a checkout or the installation.
_PACKAGES: Final = Path(__file__).parents[2]
# Packages whose version changes the last digits of results.
_DECIDING: Final = (
    "numpy",
    "scipy",
    "opencv-python-headless",
)

Item = TypeVar("Item")
Answer = TypeVar("Answer")
Task = TypeVar("Task")


class Engine:
    """Workers, started or connected on first use; a context manager that leaves no process behind.

    Parameters
    ----------
    workers : int, optional
        Number of processes on this machine, by default one per core. They are encrypted and listen
        on 127.0.0.1 only.
    scheduler : str, optional
        Address of a Dask scheduler instead.
    secure : Path, optional
        Folder with the certificate for the scheduler.
    """

    def __init__(
        self, workers: int | None, scheduler: str | None = None, secure: Path | None = None
    ) -> None:
        self.scheduler = scheduler
        self._workers = workers
        self._secure = secure
        self._client: Client | None = None
        if scheduler is not None:
            _check(scheduler, secure)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        if self._client is not None:
            cluster = self._client.cluster
            for nanny in (
                cluster.workers.values() if error is not None and cluster is not None else ()
            ):
                # Dask otherwise waits for its restart: whole tasks, and seconds on a busy machine.
                nanny.auto_restart = False
                if nanny.pid is not None:
                    with suppress(ProcessLookupError):
                        os.kill(nanny.pid, signal.SIGKILL)
            self._client.close()
            if cluster is not None:
                cluster.close()

    @property
    def client(self) -> "Client":
        """The Dask client; raises JobError if no worker is available."""
        if self._client is None:
            self._client = (
                self._begun() if self.scheduler is None else self._reached(self.scheduler)
            )
        return self._client

    def map(self, function: Callable[[Item], Answer], items: Iterable[Item]) -> Iterator[Answer]:
        """Yield the result of a function for each item, in order, as `in_parallel` does.

        Without --workers or --scheduler, threads of this process compute: transferring images takes
        longer.
        """
        if self.scheduler is None and self._workers is None:
            yield from in_parallel(function, items)
            return
        # Short inputs are shared evenly, so that no worker delays the result with a last batch.
        fair = length_hint(items, sys.maxsize) // max(_AHEAD * self._threads(), 1)
        size = min(max(fair, 1), _BATCH)
        left = iter(items)
        # Separate: it can have megabytes, and goes to each worker once.
        once = self.client.submit(partial, function, pure=False)
        waiting: deque[Future[Any]] = deque()
        for batch in iter(lambda: list(islice(left, size)), []):
            waiting.append(self.client.submit(_each, once, batch, pure=False))
            if len(waiting) >= _AHEAD * self._threads():
                yield from self._answer(waiting.popleft())
        while waiting:
            yield from self._answer(waiting.popleft())

    def graph(
        self,
        tasks: Sequence[Task],
        do: Callable[[Task], Answer],
        needs: Callable[[Task], Iterable[Task]],
    ) -> Iterator[tuple[Task, Callable[[], Answer]]]:
        """Yield finished tasks, each with a function that returns the result or raises the error.

        Tasks start when the tasks that they need are done. Tasks that need a failed task are left
        out. No task waits at a worker for another task, so that a killed worker identifies its task.
        """
        waiting = dict.fromkeys(tasks)
        under_way = dict["Future[Any]", Task]()
        while waiting or under_way:
            free = max(self._threads(), 1) - len(under_way)
            missing = {*waiting, *under_way.values()}
            ready = (task for task in waiting if missing.isdisjoint(needs(task)))
            for task in list(islice(ready, max(free, 0))):
                under_way[self.client.submit(do, task, pure=False)] = task
                del waiting[task]
            future = self._done(under_way)
            task = under_way.pop(future)
            if future.status == "error":
                waiting = dict.fromkeys(_possible(task, waiting, needs))
            yield task, partial(self._answer, future)

    def _done(self, futures: Iterable["Future[Any]"]) -> "Future[Any]":
        """Return a finished future; raise JobError if the scheduler or all workers are lost."""
        from distributed import CancelledError, wait  # noqa: PLC0415 - takes a second to import

        there_s = time.monotonic()
        at = f"--scheduler {self.scheduler}: " if self.scheduler else ""
        while time.monotonic() < there_s + _WORKER_S:
            try:
                return next(
                    iter(wait([*futures], timeout=_LOOK_S, return_when="FIRST_COMPLETED").done)
                )
            except TimeoutError:
                there_s = time.monotonic() if self._threads() else there_s
            except (
                CancelledError,
                ValueError,
            ):  # Raised by a client that lost its scheduler earlier.
                raise JobError(f"{at}connection to the scheduler lost") from None
        raise JobError(f"{at}all workers ended, and none started within {_WORKER_S:g} s")

    def _answer(self, future: "Future[Any]") -> Any:  # noqa: ANN401
        """Return the result of a worker or raise its error; raise JobError if every worker was killed."""
        from distributed import CancelledError, KilledWorker  # noqa: PLC0415

        while True:
            # Wait again if the worker with the result was killed: another worker repeats the task.
            self._done([future])
            try:
                return future.result(timeout=_WORKER_S)
            except KilledWorker:
                raise JobError("workers were killed, perhaps out of memory") from None
            except (TimeoutError, CancelledError):
                if future.status == "error":
                    raise

    def _threads(self) -> int:
        try:
            return sum(self.client.nthreads().values())
        except OSError:
            return 0  # The scheduler is lost with all pending results.

    def on_each(self, function: Callable[..., Answer], *arguments: object) -> dict[str, Answer]:
        """Return the result of a function on each worker, by address."""
        found: dict[str, Answer] = self.client.run(function, *arguments)
        return found

    def _begun(self) -> "Client":
        """Start workers on this machine."""
        distributed = _quiet_distributed()
        watched = find_spec("bokeh") is not None
        # No memory limit, because a limit kills units that need more than their share.
        start = partial(
            distributed.LocalCluster,
            n_workers=self._workers or len(os.sched_getaffinity(0)),
            threads_per_worker=1, memory_limit=0, dashboard_address="127.0.0.1:0",
            security=True, silence_logs=logging.CRITICAL, preload=[_PRELOAD],
            scheduler_kwargs={"allowed_failures": _TRIES - 1, "dashboard": watched},
        )  # fmt: skip
        cluster = _undisturbed(start)
        if watched:
            _say_watched(cluster.dashboard_link)
        # The same check as at the scheduler.
        client: Client = distributed.Client(cluster, direct_to_workers=True)
        return client

    def _reached(self, address: str) -> "Client":
        """Connect to a scheduler and check that its workers run the same program."""
        distributed = _quiet_distributed()
        security = None
        if self._secure is not None and address.startswith("tls://"):
            certificate, key = (
                str(self._secure / f"{ENGINE}{end}") for end in (CERTIFICATE_SUFFIX, KEY_SUFFIX)
            )
            certificate_of(Path(certificate), Path(certificate), Path(key))
            names = ("tls_ca_file", "tls_client_cert", "tls_client_key")
            given = dict(zip(names, (certificate, certificate, key), strict=True))
            security = distributed.Security(require_encryption=True, **given)
        try:
            client: Client = distributed.Client(address, security=security, timeout=_REACHED_S)
        except (OSError, TimeoutError) as error:
            why = " ".join(str(error).split())
            raise JobError(f"--scheduler {address}: cannot connect: {why}") from None
        self._client = client  # Closed even if a later step fails.
        try:
            client.wait_for_workers(1, timeout=_WORKER_S)
        except TimeoutError:
            raise JobError(
                f"--scheduler {address}: no worker; start one: dask worker {address}"
            ) from None
        try:
            others = [
                worker for worker, theirs in self.on_each(program).items() if theirs != program()
            ]
        except ModuleNotFoundError as error:
            raise JobError(
                f"--scheduler {address}: {error} at a worker; install SMAL there"
            ) from None
        if others:
            raise JobError(
                f"--scheduler {address}: {others[0]} has another version of SMAL or of its "
                "dependencies"
            )
        if client.dashboard_link:
            _say_watched(client.dashboard_link)
        return client


def _undisturbed(start: Callable[[], "LocalCluster"]) -> "LocalCluster":
    """Start workers without interruption, because workers that are half started end noisily.

    Ctrl-C in a terminal reaches the workers as well. They inherit that the signal is ignored.
    """
    # A helper process of Python resets the handling of Ctrl-C; it outlives the workers if a
    # terminal closes.
    heard = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGHUP})
    ensure_running()
    signal.pthread_sigmask(signal.SIG_SETMASK, heard)
    started: concurrent.futures.Future[LocalCluster] = concurrent.futures.Future()

    def work() -> None:
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            started.set_result(start())
        except BaseException as error:  # noqa: BLE001 - raised where it is asked for
            started.set_exception(error)

    threading.Thread(target=work, name="workers start", daemon=True).start()
    try:
        return started.result()
    except KeyboardInterrupt:
        with suppress(Exception):
            started.result(_WORKER_S).close()
        raise


def _check(scheduler: str, secure: Path | None) -> None:
    kind, _, place = scheduler.partition("://")
    host, _, port = place.rpartition(":")
    if kind not in ("tcp", "tls") or not host or not port.isdecimal():
        raise UsageError(
            f"--scheduler {scheduler}: invalid address; use tcp://127.0.0.1:8786, or "
            "tls://host:8786 with --secure"
        )
    if kind == "tls" and secure is None:
        raise UsageError(
            f"--scheduler {scheduler}: requires --secure, a folder created by `smal secure init`"
        )
    if kind == "tcp" and others_reach(host.strip("[]")):
        raise UsageError(
            f"--scheduler {scheduler}: unsupported: anyone can run code there; use tls://"
        )


@cache
def program() -> str:
    """Return the digest of everything that determines results: our code and package versions."""
    versions = " ".join(f"{name} {version(name)}" for name in _DECIDING)
    return digest_of(("schemas/**/*.py", "services/**/*.py", "smal/**/*.py"), versions)


def digest_of(patterns: Sequence[str], beside: str = "") -> str:
    """Return the digest of our files by these patterns, and of further text."""
    digest = hashlib.sha256(beside.encode())
    for path in sorted({path for pattern in patterns for path in _PACKAGES.glob(pattern)}):
        if path.is_file() and path.suffix != ".pyc":
            digest.update(str(path.relative_to(_PACKAGES)).encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()


def _quiet_distributed() -> Any:  # noqa: ANN401
    """Import distributed and silence its reports about connections, which users cannot act on."""
    import dask  # noqa: PLC0415 - takes a second to import
    import distributed  # noqa: PLC0415

    for name in (
        "distributed",
        *(one for one in logging.root.manager.loggerDict if one.startswith("distributed.")),
    ):
        logging.getLogger(name).setLevel(logging.CRITICAL)
    logging.getLogger("tornado").setLevel(logging.CRITICAL)
    dask.config.set({"distributed.admin.large-graph-warning-threshold": "1GB"})
    # With Dask's default a killed worker that restarts slower than 15 s is lost for good.
    dask.config.set({"distributed.deploy.lost-worker-timeout": "1h"})
    # With Dask's default the system allocates the memory of each image anew: 2.5 times the time.
    dask.config.set({"distributed.nanny.pre-spawn-environ.MALLOC_TRIM_THRESHOLD_": None})
    # Profiling and loop monitoring take a twelfth of a worker's time.
    dask.config.set(
        {"distributed.worker.profile.enabled": False, "distributed.admin.tick.interval": "500ms"}
    )
    return distributed


def _say_watched(link: str) -> None:
    tqdm.write(f"smal: dashboard of the workers: {link}", file=sys.stderr)


def _possible(
    failed: Task, tasks: Iterable[Task], needs: Callable[[Task], Iterable[Task]]
) -> Iterator[Task]:
    """Yield the tasks that need no failed task; each comes after the tasks that it needs."""
    impossible = {failed}
    for task in tasks:
        if impossible.isdisjoint(needs(task)):
            yield task
        else:
            impossible.add(task)


def _each(function: Callable[[Item], Answer], items: list[Item]) -> list[Answer]:
    return [function(one) for one in items]

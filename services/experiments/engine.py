"""The engine of work that one process is too small for: Dask, on this machine or at a scheduler that somebody runs."""

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

_REACHED_S: Final = 10.0  # A scheduler is there within this time.
#: It has a worker within this time, also where all were killed: one takes 2 s to start, 50 s on a very busy machine.
_WORKER_S: Final = 120.0
_LOOK_S: Final = 1.0  # How often whoever waits looks whether there are workers.
_BATCH: Final = (
    16  # Most items of one task: an image takes 5 ms or more, a task 5 ms of the engine's own.
)
_AHEAD: Final = 4  # Tasks for each thread of a worker that are under way.
_TRIES = 3  # How many workers may be killed at a task before it is given up.
#: What the workers of this machine do first: Ctrl-C is left to the process that ends them, which alone names damaged
#: images (`quiet_opencv`), and OpenCV has one thread: there is a worker for each core.
_PRELOAD: Final = """import signal, cv2
signal.signal(signal.SIGINT, signal.SIG_IGN)
cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
cv2.setNumThreads(1)
"""
_PACKAGES: Final = Path(__file__).parents[
    2
]  # What holds our packages: a checkout, or where they are installed.
_DECIDING: Final = (
    "numpy",
    "scipy",
    "opencv-python-headless",
)  # Of another version they give other last digits.

Item = TypeVar("Item")
Answer = TypeVar("Answer")
Task = TypeVar("Task")


class Engine:
    """Workers, started or reached when they are first needed; a context, after which no process is left.

    They are ``workers`` processes of this machine, by default one a core, for nobody else (encrypted, on 127.0.0.1), or
    those of a ``scheduler``, by the certificate in the folder ``secure``. Where they can be watched is said on standard
    error.
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
                # What it does nobody waits for, and Dask would: whole tasks, and seconds where a machine is busy.
                nanny.auto_restart = False
                if nanny.pid is not None:
                    with suppress(ProcessLookupError):  # It was killed already.
                        os.kill(nanny.pid, signal.SIGKILL)
            self._client.close()
            if cluster is not None:
                cluster.close()

    @property
    def client(self) -> "Client":
        """How work is given to the workers; JobError where there are none."""
        if self._client is None:
            self._client = (
                self._begun() if self.scheduler is None else self._reached(self.scheduler)
            )
        return self._client

    def map(self, function: Callable[[Item], Answer], items: Iterable[Item]) -> Iterator[Answer]:
        """Yield what a function makes of each item, in order, as `in_parallel` does.

        Unless workers are asked for it is done by threads of this process: images, which travel, take longer otherwise.
        """
        if self.scheduler is None and self._workers is None:
            yield from in_parallel(function, items)
            return
        # Few are shared out evenly: whoever has the last batch should not keep all others waiting.
        fair = length_hint(items, sys.maxsize) // max(_AHEAD * self._threads(), 1)
        size = min(max(fair, 1), _BATCH)
        left = iter(items)
        # An answer of its own: it may be megabytes, and goes to each worker once.
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
        """Yield tasks when they are done, each with what gives its answer or raises why there is none.

        The first that can be done are, when those are done that they need. None waits at a worker for another one: who
        was there when a worker was killed is known.
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
            yield under_way.pop(future), partial(self._answer, future)

    def _done(self, futures: Iterable["Future[Any]"]) -> "Future[Any]":
        """Wait for one of some answers and return it; JobError where no scheduler is left, or no worker for long."""
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
            ):  # The latter of a client that gave up its scheduler a while ago.
                raise JobError(f"{at}the scheduler is lost") from None
        raise JobError(f"{at}no worker is left, and none came for {_WORKER_S:g} s")

    def _answer(self, future: "Future[Any]") -> Any:  # noqa: ANN401
        """Return what a worker answered, or raise what it raised; JobError where every worker that tried was killed."""
        from distributed import CancelledError, KilledWorker  # noqa: PLC0415

        while True:
            # Waited for again where who had the answer was killed: somebody else makes it anew.
            self._done([future])
            try:
                return future.result(timeout=_WORKER_S)
            except KilledWorker:
                raise JobError("workers were killed, perhaps for memory") from None
            except (TimeoutError, CancelledError):
                if future.status == "error":
                    raise

    def _threads(self) -> int:
        try:
            return sum(self.client.nthreads().values())
        except OSError:
            return 0  # The scheduler is lost, and with it every answer that somebody waits for.

    def on_each(self, function: Callable[..., Answer], *arguments: object) -> dict[str, Answer]:
        """Return what a function says on each worker, by its address."""
        found: dict[str, Answer] = self.client.run(function, *arguments)
        return found

    def _begun(self) -> "Client":
        """Start processes of this machine."""
        distributed = _quiet_distributed()
        watched = find_spec("bokeh") is not None
        # Without a limit of memory: it would kill what works today where a unit takes more than its share.
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
        client: Client = distributed.Client(
            cluster, direct_to_workers=True
        )  # Not by the scheduler, here as well.
        return client

    def _reached(self, address: str) -> "Client":
        """Go to a scheduler, and see that its workers run the same program."""
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
            raise JobError(
                f"--scheduler {address}: cannot be reached, or refuses us: {why}"
            ) from None
        self._client = client  # Closed also where what follows fails.
        try:
            client.wait_for_workers(1, timeout=_WORKER_S)
        except TimeoutError:
            raise JobError(
                f"--scheduler {address}: has no worker (dask worker {address})"
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
                f"--scheduler {address}: {others[0]} has another version of SMAL, or of what it needs"
            )
        if client.dashboard_link:
            _say_watched(client.dashboard_link)
        return client


def _undisturbed(start: Callable[[], "LocalCluster"]) -> "LocalCluster":
    """Start workers; whoever interrupts meanwhile has them end first: what has half begun would die noisily.

    Ctrl-C in a terminal reaches the workers as well, which are deaf to it from their first moment: they inherit that.
    """
    # Whoever starts this helper of Python's hears Ctrl-C again; it outlives the workers where a terminal is closed.
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
            f"--scheduler {scheduler}: is no address; try tcp://127.0.0.1:8786, or tls://host:8786 with --secure"
        )
    if kind == "tls" and secure is None:
        raise UsageError(
            f"--scheduler {scheduler}: give --secure, a folder that `smal secure init` made"
        )
    if kind == "tcp" and others_reach(host.strip("[]")):
        raise UsageError(
            f"--scheduler {scheduler}: whoever reaches it could run anything there; only tls:// will do"
        )


@cache
def program() -> str:
    """Return the digest of all that decides what workers answer: our code, and the versions of what computes."""
    versions = " ".join(f"{name} {version(name)}" for name in _DECIDING)
    return digest_of(("schemas/**/*.py", "services/**/*.py", "smal/**/*.py"), versions)


def digest_of(patterns: Sequence[str], beside: str = "") -> str:
    """Return the digest of our files by these patterns, and of what is said beside them."""
    digest = hashlib.sha256(beside.encode())
    for path in sorted({path for pattern in patterns for path in _PACKAGES.glob(pattern)}):
        if path.is_file() and path.suffix != ".pyc":
            digest.update(str(path.relative_to(_PACKAGES)).encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()


def _quiet_distributed() -> Any:  # noqa: ANN401
    """Import it; what it has to say of its connections is nothing that a user can do anything about."""
    import dask  # noqa: PLC0415 - takes a second to import
    import distributed  # noqa: PLC0415

    for name in (
        "distributed",
        *(one for one in logging.root.manager.loggerDict if one.startswith("distributed.")),
    ):
        logging.getLogger(name).setLevel(logging.CRITICAL)
    logging.getLogger("tornado").setLevel(logging.CRITICAL)
    dask.config.set({"distributed.admin.large-graph-warning-threshold": "1GB"})
    # With Dask's own setting a killed worker that takes longer than 15 s to start anew is given up for good.
    dask.config.set({"distributed.deploy.lost-worker-timeout": "1h"})
    # With Dask's own setting each image is memory that the system has to give anew: two and a half times the time.
    dask.config.set({"distributed.nanny.pre-spawn-environ.MALLOC_TRIM_THRESHOLD_": None})
    # What looks at a worker a hundred times a second, and at its loop fifty times, takes a twelfth of its time.
    dask.config.set(
        {"distributed.worker.profile.enabled": False, "distributed.admin.tick.interval": "500ms"}
    )
    return distributed


def _say_watched(link: str) -> None:
    tqdm.write(f"smal: the workers can be watched at {link}", file=sys.stderr)


def _each(function: Callable[[Item], Answer], items: list[Item]) -> list[Answer]:
    return [function(one) for one in items]

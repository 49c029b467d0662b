"""Processes that do units of work, each after those that it needs."""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Callable, Collection, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

from services.experiments.evaluation.units import Unit
from services.kit.errors import JobError

_ONE_THREAD: Final = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")


def do_all(
    units: Sequence[Unit],
    finished: Collection[Unit],
    folder: Path,
    workers: int,
    done: Callable[[Unit, dict[str, Any]], None],
) -> None:
    """Do all units that are not finished.

    Parameters
    ----------
    units
        What is to be done; each after those that it needs.
    folder
        Where units leave files for each other.
    workers
        How many processes, at least 1.
    done
        Called in this process with each unit as it is done, and what it found.

    Raises
    ------
    JobError
        A unit failed, or a worker ended; what is done until then has been handed to `done`.
    """
    waiting = [unit for unit in units if unit not in finished]
    ready = set(finished)
    under_way: dict[Future[dict[str, Any]], Unit] = {}
    with _pool(workers) as pool:
        while waiting or under_way:
            for unit in [one for one in waiting if ready.issuperset(one.needs)][: workers - len(under_way)]:
                waiting.remove(unit)
                under_way[pool.submit(_do, unit, folder)] = unit
            for future in wait(under_way, return_when=FIRST_COMPLETED).done:
                unit = under_way.pop(future)
                try:
                    found = future.result()
                except BrokenProcessPool:
                    said = f"a worker was killed, perhaps for memory, at {unit.key} or beside it; run again to go on"
                    raise JobError(said) from None
                except Exception as error:  # noqa: BLE001 - whatever it is, it is one line
                    raise JobError(f"{unit.key}: {type(error).__name__}: {' '.join(str(error).split())}") from None
                ready.add(unit)
                done(unit, found)


@contextmanager
def _pool(workers: int) -> Iterator[ProcessPoolExecutor]:
    """Start processes when there is work; at the end, however it comes, none is left."""
    # Read when a process loads its libraries; two that compute with two threads each are slower than with one.
    os.environ.update(dict.fromkeys(_ONE_THREAD, "1"))
    before = set(multiprocessing.active_children())
    pool = ProcessPoolExecutor(workers, multiprocessing.get_context("spawn"), _begin)
    try:
        yield pool
    finally:
        for process in set(multiprocessing.active_children()) - before:
            process.kill()
        pool.shutdown(cancel_futures=True)


def _begin() -> None:
    """Leave Ctrl-C, which goes to the whole group, to the process that ends this one."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _do(unit: Unit, folder: Path) -> dict[str, Any]:
    from services.experiments.evaluation.work import do  # noqa: PLC0415 - loads what the first process does not need

    return do(unit, folder)

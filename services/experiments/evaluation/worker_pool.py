"""Processes that do the units of a plan, each after those that it needs."""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from services.experiments.evaluation.plan import Plan
from services.experiments.evaluation.schedule import Unit
from services.kit.errors import JobError

if TYPE_CHECKING:
    from services.experiments.evaluation.unit_runner import Work

_ONE_THREAD: Final = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")
#: What a unit found out, and the seconds of processor time that it took.
Found = tuple[dict[str, Any], float]


def do_all(
    plan: Plan,
    units: Sequence[Unit],
    finished: set[str],
    folder: Path,
    workers: int,
    done: Callable[[Unit, dict[str, Any], float], None],
) -> None:
    """Do all units that are not finished, each after those that it needs.

    Parameters
    ----------
    plan, units
        What is to be done; each unit after those that it needs.
    finished
        Keys of the units that need not be done.
    folder
        Where units leave files for each other.
    workers
        How many processes, at least 1.
    done
        Called in this process with each unit as it is done, what it found, and its seconds of processor time.

    Raises
    ------
    JobError
        A unit failed, or a worker ended; what is done until then has been handed to `done`.
    """
    waiting = [unit for unit in units if unit.key not in finished]
    ready = set(finished)
    under_way: dict[Future[Found], Unit] = {}
    with _pool(workers) as pool:
        while waiting or under_way:
            for unit in [one for one in waiting if ready.issuperset(one.needs)][: workers - len(under_way)]:
                waiting.remove(unit)
                under_way[_submit(pool, plan, folder, unit)] = unit
            for future in wait(under_way, return_when=FIRST_COMPLETED).done:
                unit = under_way.pop(future)
                finding, seconds = _found(future, unit)
                ready.add(unit.key)
                done(unit, finding, seconds)


@contextmanager
def _pool(workers: int) -> Iterator[ProcessPoolExecutor]:
    """Start processes when there is work; at the end, however it comes, none is left."""
    # Read when a process loads its libraries; two that compute with two threads each are slower than with one.
    os.environ.update(dict.fromkeys(_ONE_THREAD, "1"))
    pool = ProcessPoolExecutor(workers, multiprocessing.get_context("spawn"))
    before = set(multiprocessing.active_children())
    try:
        yield pool
    finally:
        for process in set(multiprocessing.active_children()) - before:
            process.kill()
        pool.shutdown(cancel_futures=True)


def _submit(pool: ProcessPoolExecutor, plan: Plan, folder: Path, unit: Unit) -> Future[Found]:
    """Have a unit done; Ctrl-C, which goes to the whole group, does not reach who does it: this process ends them."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        return pool.submit(_do, plan, folder, unit)
    except BrokenProcessPool:
        raise _ended(unit) from None
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _found(future: Future[Found], unit: Unit) -> Found:
    try:
        return future.result()
    except BrokenProcessPool:
        raise _ended(unit) from None
    except Exception as error:  # noqa: BLE001 - whatever it is, it is one line
        raise JobError(f"{unit.key}: {type(error).__name__}: {' '.join(str(error).split())}") from None


def _ended(unit: Unit) -> JobError:
    return JobError(f"a worker was killed, perhaps for memory, at {unit.key} or beside it; run again to go on")


@cache
def _work(plan: Plan, folder: Path) -> Work:
    from services.experiments.evaluation.unit_runner import Work  # noqa: PLC0415 - loads what the first process does not need

    return Work(plan, folder)


def _do(plan: Plan, folder: Path, unit: Unit) -> Found:
    return _work(plan, folder).do(unit)

"""Processes that do the units of a plan, and the order in which they do them."""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess
from pathlib import Path
from typing import Any, Final

from services.experiments.evaluation.plan import Plan
from services.experiments.evaluation.units import Unit
from services.kit.errors import JobError

_ONE_THREAD: Final = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")
Done = Callable[[Unit, dict[str, Any], float], None]


@dataclass
class _Worker:
    """A process, the pipe to it, and what it is doing."""

    process: SpawnProcess
    pipe: Connection
    unit: Unit | None = None
    last: Unit | None = None


def do_all(plan: Plan, units: Sequence[Unit], finished: set[str], folder: Path, workers: int, done: Done) -> None:
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
    with _started(plan, folder, min(workers, max(1, len(waiting)))) as crew:
        while waiting or any(worker.unit for worker in crew):
            for worker in crew:
                if worker.unit is None:
                    _give(worker, waiting, ready)
            busy = [worker for worker in crew if worker.unit is not None]
            heard = wait([*(worker.pipe for worker in busy), *(worker.process.sentinel for worker in busy)])
            for worker in busy:
                if worker.pipe in heard or worker.process.sentinel in heard:
                    unit = worker.unit
                    assert unit is not None  # noqa: S101 - it is busy
                    finding, seconds = _receive(worker, unit)
                    worker.unit, worker.last = None, unit
                    ready.add(unit.key)
                    done(unit, finding, seconds)


def _give(worker: _Worker, waiting: list[Unit], ready: set[str]) -> None:
    """Give a worker one of the units whose needs are met: one like its last, for which it has everything open."""
    possible = [unit for unit in waiting if all(need in ready for need in unit.needs)]
    if not possible:
        return
    unit = max(possible, key=lambda one: _likeness(one, worker.last))
    waiting.remove(unit)
    try:
        worker.pipe.send(unit)
    except OSError:
        raise _ended(worker, unit) from None
    worker.unit = unit


def _likeness(unit: Unit, last: Unit | None) -> tuple[bool, int]:
    """Say how much of what a worker has open a unit uses; what others wait for comes first of all."""
    preparing = unit.kind in {"teach", "learn", "queries"}
    if last is None:
        return preparing, 0
    same = dict(unit.settings).items() & dict(last.settings).items()
    return preparing, 8 * (unit.world == last.world) + 4 * (unit.kind == last.kind) + sum(
        name in {"length", "controller", "method"} for name, _ in same
    )


def _receive(worker: _Worker, unit: Unit) -> tuple[dict[str, Any], float]:
    try:
        problem, finding, seconds = worker.pipe.recv()
    except (EOFError, OSError):
        raise _ended(worker, unit) from None
    if problem is not None:
        raise JobError(f"{unit.key}: {problem}")
    return finding, seconds


def _ended(worker: _Worker, unit: Unit) -> JobError:
    worker.process.join()
    return JobError(f"a worker ended with status {worker.process.exitcode} at {unit.key}; run again to go on")


@contextmanager
def _started(plan: Plan, folder: Path, count: int) -> Iterator[list[_Worker]]:
    """Start processes; at the end, however it comes, none is left."""
    context = multiprocessing.get_context("spawn")
    before = {name: os.environ.get(name) for name in _ONE_THREAD}
    # Read when a process loads its libraries; two that compute with two threads each are slower than with one.
    os.environ.update(dict.fromkeys(_ONE_THREAD, "1"))
    crew = []
    try:
        for _ in range(count):
            ours, theirs = context.Pipe()
            process = context.Process(target=_labour, args=(theirs, plan, folder), daemon=True)
            _start(process)
            theirs.close()
            crew.append(_Worker(process, ours))
        yield crew
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
        for worker in crew:
            worker.pipe.close()
            worker.process.kill()
            worker.process.join()


def _start(process: SpawnProcess) -> None:
    """Start a process that Ctrl-C does not reach, which goes to the whole group: this process ends the others."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        process.start()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _labour(pipe: Connection, plan: Plan, folder: Path) -> None:
    """Do what comes over the pipe until it closes; an error is one line, which the other side raises."""
    from services.experiments.evaluation.work import Work  # noqa: PLC0415 - loads what the first process does not need

    work = Work(plan, folder)
    while True:
        try:
            unit = pipe.recv()
        except (EOFError, ConnectionError):
            return
        try:
            answer: tuple[str | None, dict[str, Any], float] = (None, *work.do(unit))
        except Exception as error:  # noqa: BLE001 - whatever it is, the other process says it
            answer = (f"{type(error).__name__}: {' '.join(str(error).split())}", {}, 0.0)
        try:
            pipe.send(answer)
        except (BrokenPipeError, ConnectionError):
            return

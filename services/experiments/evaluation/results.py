"""Results of an evaluation: a file for each unit, named by what determines it, that is there only when it is whole."""

import json
import multiprocessing
import os
import signal
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from services.experiments.evaluation.units import Finding, Unit
from services.kit.errors import JobError
from smal.files.container import replacing

_ONE_THREAD: Final = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")


class Results:
    """The results of some units: ``findings``, and in the folder ``work`` their files; JobError: one is none."""

    def __init__(self, folder: Path, units: Sequence[Unit]) -> None:
        self.folder, self.work = folder, folder / "units"
        self.work.mkdir(parents=True, exist_ok=True)
        self.findings: dict[Unit, Finding] = {unit: found for unit in units if (found := self._read(unit)) is not None}

    def _path(self, unit: Unit) -> Path:
        return self.work / f"{unit.name}.json"

    def _read(self, unit: Unit) -> Finding | None:
        path = self._path(unit)
        if not path.exists():
            return None
        try:
            found: Finding = json.loads(path.read_text(encoding="utf-8"))["finding"]
            missing = found.get("file") and not unit.file(self.work).exists()
        except (ValueError, LookupError, TypeError, AttributeError):
            raise JobError(f"{path}: is no result; delete it to have it made again") from None
        return None if missing else found

    def add(self, unit: Unit, finding: Finding) -> None:
        """Write what a unit found out."""
        text = json.dumps({"unit": repr(unit), "finding": finding}, allow_nan=False) + "\n"
        with replacing(self._path(unit)) as file:
            file.write(text.encode())
        self.findings[unit] = finding

    def complete(self, units: Sequence[Unit], workers: int, done: Callable[[], object]) -> None:
        """Do in processes what is not done, and call `done` after each; JobError where one failed: the rest is kept."""
        what = ""
        try:
            with _pool(workers) as pool:
                while left := [unit for unit in units if unit not in self.findings]:
                    ready = [unit for unit in left if self.findings.keys() >= set(unit.needs)]
                    under_way = {pool.submit(unit.timed, self.work): unit for unit in ready}
                    for future in as_completed(under_way):
                        unit = under_way[future]
                        what = f"{type(unit).__name__.lower()} in {unit.site.world}"
                        self.add(unit, future.result())
                        done()
        except BrokenProcessPool:
            said = f"a worker was killed, perhaps for memory, at {what} or beside it; run again to go on"
            raise JobError(said) from None
        except Exception as error:  # noqa: BLE001 - whatever it is, it is one line
            raise JobError(f"{what}: {type(error).__name__}: {' '.join(str(error).split())}") from None


@contextmanager
def _pool(workers: int) -> Iterator[ProcessPoolExecutor]:
    """Start processes when there is work; at the end, however it comes, none is left."""
    # Read when a process loads its libraries; two that compute with two threads each are slower than with one.
    os.environ.update(dict.fromkeys(_ONE_THREAD, "1"))
    before = set(multiprocessing.active_children())
    ignoring = (signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is left to the process that ends the others.
    pool = ProcessPoolExecutor(workers, multiprocessing.get_context("spawn"), signal.signal, ignoring)
    try:
        yield pool
    finally:
        for process in set(multiprocessing.active_children()) - before:
            process.kill()
        pool.shutdown(cancel_futures=True)

"""Distribution of the tests over processes; costly fixtures are made once a run."""

import fcntl
import os
from collections.abc import Callable
from pathlib import Path
from typing import Final

import pytest
from xdist.scheduler import LoadScopeScheduling
from xdist.workermanage import WorkerController

#: Folders that drive robots in real time. One process does all of them: two robots at once are too much for two cores.
REAL_TIME: Final = ("tests/system/", "tests/ros2/", "tests/serial/")
#: Order of the longest tests. If they began late, the other processes would wait for them.
FIRST: Final = (
    *REAL_TIME,
    "tests/smal/",
    "tests/services/simulator/test_scans.py",
    "tests/services/robot/test_other_simulators.py",
)


class Sharing(LoadScopeScheduling):
    """Gives a process that is free the next file, with what its tests share, or all of `REAL_TIME`."""

    def _split_scope(self, nodeid: str) -> str:
        file, _, _ = nodeid.partition("::")
        return "real time" if nodeid.startswith(REAL_TIME) else file

    def remove_node(self, node: WorkerController) -> str | None:
        """Share out what a process had left; return the test that it crashed in, which has failed.

        xdist would run that test again, and its success would hide the crash.
        """
        files = self.assigned_work.pop(node)
        left = [
            (file, test)
            for file, tests in files.items()
            for test, done in tests.items()
            if not done
        ]
        if not left:
            return None
        file, crashed = left[0]
        files[file][crashed] = True
        self.workqueue.update(files)
        for other in self.assigned_work:
            self._reschedule(other)
        return crashed

    def _reschedule(self, node: WorkerController) -> None:
        """Give a process files until it has two tests to run, or let it end.

        A process starts a test once it knows the next one, and reports nothing about a file that a
        crashed process had finished. xdist gives it one file, and can wait for it forever.
        """
        super()._reschedule(node)
        while not node.shutting_down and self._pending_of(self.assigned_work[node]) < 2:
            super()._reschedule(node)


def made_once(factory: pytest.TempPathFactory, name: str, make: Callable[[Path], None]) -> Path:
    """Return a folder that ``make`` has filled, in this process or, while this one waited, in another.

    Parameters
    ----------
    factory
        Where this process has its folders.
    name
        The folder's, and no other's.
    make
        Fills the empty folder.
    """

    def made() -> Path:
        folder = factory.mktemp(name)
        make(folder)
        return folder

    if "PYTEST_XDIST_WORKER" not in os.environ:
        return made()
    # Each process has a folder of its own in that of the run.
    where = factory.getbasetemp().parent / f"{name}.path"
    with where.with_suffix(".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not where.exists():
            where.write_text(str(made()))
    return Path(where.read_text())

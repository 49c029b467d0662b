"""``smal bench``: run a benchmark of the checkout, with a fixed number of threads."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Annotated, Final

import typer
from typer import Argument, Option

from services.cli.interrupts import interrupted_by_signals
from services.cli.stack.child import tied
from services.kit.errors import JobError, UsageError

#: Where benchmarks are: beside the packages, in a checkout only.
FOLDER: Final = Path(__file__).parents[2] / "tests" / "benchmarks"
#: Read by numerical libraries when they are loaded, so they must be set before the benchmark starts.
THREADS: Final = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")
_STOP_TIMEOUT_S: Final = 10.0


def bench(
    context: typer.Context,
    name: Annotated[str, Argument(help="Which benchmark.")],
    threads: Annotated[int, Option(min=1, help="Threads of the numerical libraries.")] = 1,
) -> None:
    """Run a benchmark, print its tables and write its results as JSON. It needs a checkout of the project.

    All benchmarks have --json FILE, --out DIR (pictures) and --quick (a minute or two). Other options are each
    benchmark's own; smal bench NAME -- --help explains them.

    recognition: matching over one product, against other solvers. bus: messages over those of plain Zenoh. latency:
    from the capture of a frame to its command. faults: kills, freezes, outages, a full disk, floods. soak: memory
    and descriptors over an hour, or of the page. route: a decision on a way of one kilometre.

    Example: smal bench recognition --json results.json --out pictures
    """
    known = benchmarks(FOLDER)
    if name not in known:
        raise UsageError(f"no benchmark {name!r}; known are: {', '.join(known)}")
    status = _run([name, *context.args], threads)
    if status:
        raise typer.Exit(status)


def benchmarks(folder: Path) -> list[str]:
    """Name the benchmarks in a folder: each is a package; raises JobError where there is no such folder."""
    if not folder.is_dir():
        raise JobError("benchmarks need a checkout of the project; run deploy/setup.sh in one, then smal bench")
    return [path.parent.name for path in sorted(folder.glob("*/benchmark.py"))]


def _run(arguments: list[str], threads: int) -> int:
    """Run a benchmark of the checkout in a process that ends with this one; return its exit status."""
    path = os.pathsep.join(filter(None, [str(FOLDER.parents[1]), os.environ.get("PYTHONPATH")]))
    environment = os.environ | dict.fromkeys(THREADS, str(threads)) | {"PYTHONPATH": path}
    # -P: packages of the folder that the user is in, which may have a `tests` as well, are not looked at.
    command = tied(sys.executable, "-P", "-m", "tests.benchmarks", *arguments)
    with interrupted_by_signals(), subprocess.Popen(command, env=environment) as process:  # noqa: S603
        try:
            return process.wait()
        except KeyboardInterrupt:
            _stop(process)
            raise


def _stop(process: subprocess.Popen[bytes]) -> None:
    """End the benchmark, which may have a simulator to stop; Ctrl-C has reached it as well."""
    process.send_signal(signal.SIGTERM)
    try:
        process.wait(_STOP_TIMEOUT_S)
    except subprocess.TimeoutExpired:
        process.kill()

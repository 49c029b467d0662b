"""``smal bench``: run a benchmark of the checkout, with a fixed number of threads."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Annotated, Final

import typer

from services.cli import options
from services.cli.interrupts import interrupted_by_signals
from services.cli.stack.child import tied
from services.cli.stack.processes import flags
from services.kit.errors import JobError, UsageError

#: Where benchmarks are: beside the packages, in a checkout only.
FOLDER: Final = Path(__file__).parents[2] / "tests" / "benchmarks"
#: Read by numerical libraries when they are loaded, so they must be set before the benchmark starts.
THREADS: Final = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
_STOP_TIMEOUT_S: Final = 10.0


def bench(
    context: typer.Context,
    name: Annotated[str, typer.Argument(help="Which: bus, faults, latency, recognition, recorder, rendering, soak.")],
    json_file: options.JsonFile = None,
    out: Annotated[Path | None, typer.Option(help="Folder for pictures.")] = None,
    quick: Annotated[bool, typer.Option("--quick", help="A small run, of a minute or two.")] = False,
    threads: Annotated[int, typer.Option(min=1, help="Threads of the numerical libraries.")] = 1,
) -> None:
    """Run a benchmark, print its tables and write its results as JSON. It needs a checkout of the project.

    Options that are not listed here are the benchmark's own; smal bench NAME -- --help lists them.

    recognition: time of matching over one product, against other solvers; --recordings DIR (drives made by smal
    demonstrate --camera 320x240; without it some are driven).

    bus: time of a message from process to process over that of plain Zenoh; --rate HZ;
    --secure: what certificates cost; --flood: what a flood costs commands.

    latency: from the capture of a frame to its command, in real time; --model FILE and --recordings DIR (without them
    both are made), --camera, --ticks, --watchers.

    faults: a driving stack under kills, freezes, outages, a full disk, a jumping clock and floods; --cell NAME (may be
    repeated), --model FILE. The cells "floods" and "floods with certificates": does it obey an emergency stop.

    soak: memory and descriptors over an hour; --minutes M, --model FILE,
    --page: what the console's page holds in a browser, over ten minutes.

    recorder: what its process holds while a drive of hours is recorded; --hours H.

    rendering: time of a frame of each scene over a trivial one; --map FILE.

    Example: smal bench recognition --json results.json --out pictures
    """
    known = benchmarks(FOLDER)
    if name not in known:
        raise UsageError(f"no benchmark {name!r}; known are: {', '.join(known)}")
    own = flags(json=json_file, out=out) + (("--quick",) if quick else ())
    status = _run([name, *own, *context.args], threads)
    if status:
        raise typer.Exit(status)


def benchmarks(folder: Path) -> list[str]:
    """Name the benchmarks in a folder: each is a package.

    Raises
    ------
    JobError
        There is no such folder.
    """
    if not folder.is_dir():
        raise JobError(
            "benchmarks need a checkout of the project: run deploy/setup.sh in one, then .venv/bin/smal bench"
        )
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

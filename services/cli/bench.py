"""``smal bench``: run a benchmark of the checkout, with a fixed number of threads."""

import os
import sys
from pathlib import Path
from typing import Annotated, Final

import typer
from typer import Argument, Option

from services.kit.errors import JobError, UsageError

CHECKOUT: Final = Path(__file__).parents[2]  # Where benchmarks are: beside the packages, in a checkout only.
#: Read by numerical libraries when they are loaded, so they must be set before the benchmark starts.
THREADS: Final = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")


def bench(
    context: typer.Context,
    name: Annotated[str, Argument(help="Which benchmark.")],
    threads: Annotated[int, Option(min=1, help="Threads of the numerical libraries.")] = 1,
) -> None:
    """Run a benchmark, print its tables and write its results as JSON. It needs a checkout of the project.

    All benchmarks have --json FILE, --out DIR (pictures) and --quick (a minute or two). Other options are each
    benchmark's own; smal bench NAME -- --help explains them.

    recognition: matching over one product, against other solvers. bus: messages over those of plain Zenoh. faults:
    kills, freezes, outages, a full disk, floods. soak: memory and descriptors over an hour, or of the page. route:
    learning a drive, and a decision on a way of one kilometre. places: large traverses. belief: what each
    part of the filter is for, and whether its probabilities hold. fleet: 1, 2, 4 and 8 robots at once. link: a robot
    by Wi-Fi that delays, loses and breaks (as root).

    Example: smal bench recognition --json results.json --out pictures
    """
    known = sorted(path.parent.name for path in CHECKOUT.glob("tests/benchmarks/*/benchmark.py"))
    if not known:
        raise JobError("benchmarks need a checkout of the project; run deploy/setup.sh in one, then smal bench")
    if name not in known:
        raise UsageError(f"no benchmark {name!r}; known are: {', '.join(known)}")
    path = os.pathsep.join(filter(None, [str(CHECKOUT), os.environ.get("PYTHONPATH")]))
    # -P: packages of the folder that the user is in, which may have a `tests` as well, are not looked at.
    command = [sys.executable, "-P", "-m", "tests.benchmarks", name, *context.args]
    # In place of this process: whoever ends this one ends the benchmark.
    os.execve(command[0], command, os.environ | dict.fromkeys(THREADS, str(threads)) | {"PYTHONPATH": path})  # noqa: S606

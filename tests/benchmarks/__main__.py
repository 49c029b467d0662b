"""Run a benchmark from the root of a checkout: ``python -m tests.benchmarks NAME``; ``NAME --help`` lists its options.

Numerical libraries use one thread, unless ``OMP_NUM_THREADS`` sets another number.
"""

import importlib
import sys
from typing import Final

from services.cli.interrupts import interrupted_by_signals
from services.kit.errors import JobError, UsageError, describe_os_error
from services.kit.process import EXIT_FAILED, EXIT_USAGE

#: The module of each benchmark, which has a function `main`.
BENCHMARKS: Final = {
    **{
        name: f"{name}.benchmark"
        for name in ("belief", "bus", "faults", "recognition", "rooms", "senses")
    },
    **{name: name for name in ("fleet", "link", "places", "route", "soak")},
}


def run(arguments: list[str]) -> int:
    """Run the benchmark that the first argument names; return the exit status."""
    name = arguments[0] if arguments else "--help"
    if name == "--help":
        sys.stdout.write(f"{__doc__}\nBenchmarks: {', '.join(BENCHMARKS)}\n")
        return 0
    try:
        if name not in BENCHMARKS:
            raise UsageError(f"benchmark {name!r} not found; use one of {', '.join(BENCHMARKS)}")
        with interrupted_by_signals():
            module = importlib.import_module(f"tests.benchmarks.{BENCHMARKS[name]}")
            module.main(arguments[1:])
    except KeyboardInterrupt:
        sys.stderr.write("smal: interrupted\n")
        return 130
    except (UsageError, JobError, OSError) as error:
        said = describe_os_error(error) if isinstance(error, OSError) else str(error)
        sys.stderr.write(f"smal: {said}\n")
        return EXIT_USAGE if isinstance(error, UsageError) else EXIT_FAILED
    return 0


if __name__ == "__main__":
    sys.exit(run(sys.argv[1:]))

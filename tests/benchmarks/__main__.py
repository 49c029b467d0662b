"""Run a benchmark: ``smal bench NAME``."""

import importlib
import sys

from services.cli.interrupts import interrupted_by_signals
from services.kit.errors import JobError, UsageError, describe_os_error
from services.kit.process import EXIT_FAILED, EXIT_USAGE


def run(name: str, arguments: list[str]) -> int:
    """Run one of the packages beside this file; return the exit status."""
    try:
        with interrupted_by_signals():
            importlib.import_module(f"tests.benchmarks.{name}.benchmark").main(arguments)
    except KeyboardInterrupt:
        sys.stderr.write("smal: interrupted\n")
        return 130
    except (UsageError, JobError, OSError) as error:
        said = describe_os_error(error) if isinstance(error, OSError) else str(error)
        sys.stderr.write(f"smal: {said}\n")
        return EXIT_USAGE if isinstance(error, UsageError) else EXIT_FAILED
    return 0


if __name__ == "__main__":
    sys.exit(run(sys.argv[1], sys.argv[2:]))

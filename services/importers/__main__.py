"""One import in a process of its own: a job as JSON in, lines of JSON out.

The libraries that decode Parquet, video and images are written in C and C++. What a stranger's file makes them do,
a crash or a demand for all memory, ends this process and no other.
"""

from __future__ import annotations

import json
import resource
import sys
import time
from typing import Final

from services.importers.drive import ImportFailure, Tally
from services.importers.job import Job, Progress, run
from services.kit.errors import describe_os_error

#: Memory that an import may take, bytes; numbers of the longest drive that is read take a quarter of it.
MOST_MEMORY: Final = 2 * 2**30
#: Between two reports of progress, seconds.
_PERIOD_S: Final = 0.1


def main() -> int:
    """Run the job; the exit status is 1 where it failed."""
    # What is mapped from files does not count: bags are larger than this.
    resource.setrlimit(resource.RLIMIT_DATA, (MOST_MEMORY, MOST_MEMORY))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    job, tally = Job.model_validate_json(sys.stdin.read()), Tally()
    try:
        report = run(job, tally, _progress())
    except ImportFailure as error:
        _tell(error=str(error))
        return 1
    except MemoryError:
        _tell(error=f"{job.path}: reading it takes more than {MOST_MEMORY >> 30} GiB of memory")
        return 1
    except OSError as error:
        _tell(error=describe_os_error(error))
        return 1
    _tell(remarks=tally.lines(), report=report.model_dump(mode="json"))
    return 0


def _progress() -> Progress:
    told_s = 0.0

    def tell(done: int, total: int) -> None:
        nonlocal told_s
        if time.monotonic() - told_s >= _PERIOD_S:
            told_s = time.monotonic()
            _tell(done=done, total=total)

    return tell


def _tell(**what: object) -> None:
    sys.stdout.write(json.dumps(what) + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main())

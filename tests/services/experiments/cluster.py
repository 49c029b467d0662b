"""A scheduler of Dask and a worker of it, as a user starts them: processes of their own, with certificates."""

import os
import re
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

ROOT = Path(__file__).parents[3]


@contextmanager
def scheduler_and_worker(keys: Path, folder: Path) -> Iterator[str]:
    """Start them; yield the scheduler's address."""
    certificate = str(keys / "engine.pem")
    tls = [
        "--tls-ca-file", certificate, "--tls-cert", certificate, "--tls-key",
        str(keys / "engine.key"),
    ]  # fmt: skip
    here = ["--host", "127.0.0.1", "--protocol", "tls", *tls]

    def start(*arguments: str) -> "subprocess.Popen[str]":
        command = [sys.executable, "-m", "dask", *arguments]
        environment = os.environ | {
            "PYTHONPATH": str(ROOT),
            "DASK_TEMPORARY_DIRECTORY": str(folder),
        }
        return subprocess.Popen(
            command, cwd=folder, stderr=subprocess.PIPE, text=True, env=environment
        )

    scheduler = start("scheduler", "--port", "0", "--no-dashboard", *here)
    worker = None
    try:
        found = (re.search(r"Scheduler at:\s+(tls://\S+)", line) for line in scheduler.stderr)
        address = next(one[1] for one in found if one)
        worker = start("worker", address, "--nthreads", "1", "--no-dashboard", *here)
        yield address
    finally:
        for process in filter(None, (worker, scheduler)):
            process.terminate()
            process.communicate()

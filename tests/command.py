"""The ``smal`` command as a user runs it."""

import os
import subprocess
import sys

from tests.services.waiting import DEADLINE_S


def run_smal(
    *arguments: object, timeout_s: float = DEADLINE_S, typed: str | None = None, **environment: str
) -> subprocess.CompletedProcess[str]:
    """Run ``smal`` with arguments and typed input; return its status and output."""
    return subprocess.run(
        [sys.executable, "-c", "from services.cli.main import main; main()", *map(str, arguments)],
        capture_output=True,
        text=True,
        input=typed,
        timeout=timeout_s,
        check=False,
        env=os.environ | environment,
    )

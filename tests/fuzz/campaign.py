"""Run one target for a while in a process of its own, and tell what came of it."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
#: An input that takes longer, or a process that grows larger, is a finding.
TIMEOUT_S = 10
MEMORY_MB = 1024
LONGEST_INPUT = 100_000
#: What a process may take to start, and to end after its time.
_SLACK_S = 60
#: The decoders of files read thousands of small ones a second; better from memory, where the machine has such a place.
_MEMORY = Path("/dev/shm")  # noqa: S108 - a folder of our own is made in it


@dataclass(frozen=True)
class Campaign:
    """What fuzzing a target for a while gave.

    Attributes
    ----------
    name
        The target.
    executions
        Inputs tried.
    crashers
        Files with the inputs that broke it.
    status
        Exit status of the process.
    output
        All that the fuzzer said.
    """

    name: str
    executions: int
    crashers: tuple[Path, ...]
    status: int
    output: str

    @property
    def clean(self) -> bool:
        """Whether the fuzzer ran, and found nothing."""
        return self.status == 0 and not self.crashers and self.executions > 0

    @property
    def finding(self) -> str:
        """The end of what the fuzzer said, where it found something."""
        lines = self.output.splitlines(keepends=True)
        begins = (at for at, line in enumerate(lines) if "Uncaught Python exception" in line or line.startswith("=="))
        start = next(begins, 0)
        return "" if self.clean else "".join(lines[start:][:60])

    def line(self) -> str:
        """Say it in one line."""
        kept = ", ".join(str(path) for path in self.crashers) or ("" if self.clean else f"status {self.status}")
        return f"{self.name:10} {self.executions:9,d} executions  {'clean' if self.clean else 'BROKEN: ' + kept}"


def fuzz(name: str, seconds: int, crashers: Path) -> Campaign:
    """Fuzz one target; inputs that break it are kept in ``<crashers>/<name>/``."""
    folder = crashers / name
    folder.mkdir(parents=True, exist_ok=True)
    before = set(folder.iterdir())
    flags = [
        f"-max_total_time={seconds}", f"-timeout={TIMEOUT_S}", f"-rss_limit_mb={MEMORY_MB}",
        f"-max_len={LONGEST_INPUT}", f"-artifact_prefix={folder}/", "-report_slow_units=3600",
    ]  # fmt: skip
    # libFuzzer ends its process without cleaning up, so that what it leaves must be somewhere that we can remove.
    with tempfile.TemporaryDirectory(prefix="smal-fuzz-", dir=_MEMORY if _MEMORY.is_dir() else None) as scratch:
        # By a shell in between: libFuzzer goes by the peak of its process's memory, which begins, after a fork and an
        # exec, with all that this process holds; the shell's own child begins with the little that the shell does.
        done = subprocess.run(
            ["sh", "-c", '"$@"; exit $?', "sh", sys.executable, "-m", "tests.fuzz.worker", name, *flags],
            env=os.environ | {"TMPDIR": scratch},
            cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, timeout=seconds + _SLACK_S, check=False,
        )  # fmt: skip
    output = done.stdout.decode(errors="replace")
    counts = [int(count) for count in re.findall(r"^(?:Done |#)(\d+)", output, re.MULTILINE)]
    found = tuple(sorted(set(folder.iterdir()) - before))
    if not any(folder.iterdir()):
        folder.rmdir()
    return Campaign(name, max(counts, default=0), found, done.returncode, output)

"""Sources of ``smal import`` of which some files are the input, one behind the other.

Parquet and MP4 files are decoded by other people's C++: what that does with bytes that were changed at random is no
promise of ours, and happens in a process of its own. So the fuzzer changes what we read ourselves.
"""

from __future__ import annotations

import random
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Final

from services.importers.drive import ImportFailure, Tally
from services.importers.job import Format, Job
from services.importers.run import run
from tests.fuzz import trees
from tests.fuzz.targets import check_line, scratch

_END: Final = b"\n\x1e\n"


def accepted(form: Format, source: Path) -> bool:
    """Import a source, and say whether that was possible; what is said of it is lines, either way."""
    out = scratch.folder() / "out"
    out.mkdir(exist_ok=True)
    tally = Tally()
    job = Job(format=form, path=str(source), folder=str(out), robot="burger")
    try:
        report = run(job, tally)
    except ImportFailure as error:
        check_line(error)
        return False
    finally:
        shutil.rmtree(out)
        for line in tally.lines():
            check_line(line)
    assert report.ticks > 0
    return True


@dataclass
class Lines:
    """A source with files of lines, each JSON or a row of a table; one of the seeds has a text in another's place."""

    form: Format
    make: Callable[[Path], Path]
    files: tuple[str, ...]
    instead: tuple[bytes, bytes]

    @cached_property
    def _made(self) -> tuple[Path, bytes]:
        folder = self.make(scratch.folder() / self.form)
        return folder, _END.join((folder / name).read_bytes() for name in self.files)

    def seeds(self) -> list[bytes]:
        """Return the whole one, a changed one, and one that ends early."""
        whole = self._made[1]
        return [whole, whole.replace(*self.instead), b"\n".join(whole.splitlines()[:8])]

    def run(self, data: bytes) -> bool:
        """Import the source with these files."""
        folder, _ = self._made
        parts = [*data.split(_END), *[b""] * len(self.files)]
        for name, part in zip(self.files, parts, strict=False):
            (folder / name).write_bytes(part)
        return accepted(self.form, folder)

    def mutate(self, data: bytes, rng: random.Random) -> bytes | None:
        """Change a line, one of the first as often as any."""
        lines = data.split(b"\n")
        at = rng.randrange(rng.choice((min(5, len(lines)), len(lines))))
        changed = trees.changed_json(lines[at], rng)
        if changed is None:
            row = lines[at].split(b",")
            row[rng.randrange(len(row))] = str(rng.choice(trees.ODD)).encode(errors="replace")
            changed = b",".join(row)
        return b"\n".join([*lines[:at], changed.replace(b"\n", b""), *lines[at + 1 :]])

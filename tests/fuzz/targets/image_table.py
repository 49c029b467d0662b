"""``smal import folder`` of its CSV file."""

from __future__ import annotations

import random
from functools import cache
from pathlib import Path

from tests.fuzz import trees
from tests.fuzz.targets import imported, scratch
from tests.services.importers import sources


@cache
def _folder() -> Path:
    return sources.csv_folder(scratch.folder() / "pictures", rate_hz=10.0)


@cache
def seeds() -> list[bytes]:
    table = (_folder() / "drive.csv").read_bytes()
    return [table, table.replace(b"x_m", b"episode"), b"\n".join(table.splitlines()[:4])]


def run(data: bytes) -> bool:
    seeds()  # before its file is another
    (_folder() / "drive.csv").write_bytes(data)
    return imported.accepted("folder", _folder())


def mutate(data: bytes, rng: random.Random) -> bytes | None:
    """Change one value."""
    rows = [line.split(b",") for line in data.splitlines()]
    if not rows:
        return None
    row = rng.choice(rows)
    row[rng.randrange(len(row))] = str(rng.choice(trees.ODD)).encode(errors="replace")
    return b"\n".join(b",".join(row) for row in rows)

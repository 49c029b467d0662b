"""``smal import donkeycar`` of a tub's manifest and catalog."""

from __future__ import annotations

import random
from functools import cache
from pathlib import Path

from tests.fuzz import trees
from tests.fuzz.targets import imported, scratch
from tests.services.importers import sources

_MANIFEST, _CATALOG = "manifest.json", "catalog_0.catalog"
#: Lines of a manifest.
_LINES = 5


@cache
def _tub() -> Path:
    return sources.donkeycar(scratch.folder() / "tub", rate_hz=10.0)


@cache
def seeds() -> list[bytes]:
    manifest, catalog = ((_tub() / name).read_bytes() for name in (_MANIFEST, _CATALOG))
    return [manifest + catalog, manifest + b"\n".join(catalog.splitlines()[:3])]


def run(data: bytes) -> bool:
    lines = data.splitlines(keepends=True)
    (_tub() / _MANIFEST).write_bytes(b"".join(lines[:_LINES]))
    (_tub() / _CATALOG).write_bytes(b"".join(lines[_LINES:]))
    return imported.accepted("donkeycar", _tub())


def mutate(data: bytes, rng: random.Random) -> bytes | None:
    """Change the JSON of a line, of the catalogs' list as often as of a record."""
    lines = data.splitlines()
    if len(lines) <= _LINES:
        return None
    at = rng.choice((_LINES - 1, rng.randrange(_LINES, len(lines))))
    changed = trees.changed_json(lines[at], rng)
    return None if changed is None else b"\n".join([*lines[:at], changed.replace(b"\n", b""), *lines[at + 1 :]])

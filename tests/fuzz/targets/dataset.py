"""``smal import lerobot`` of a data set's description; its Parquet and MP4 files are decoded by other people's C++.

What that does with bytes that were changed at random is no promise of ours: it happens in a process of its own. So the
fuzzer changes what we read ourselves.
"""

from __future__ import annotations

import random
import shutil
from functools import cache
from pathlib import Path

from tests.fuzz import trees
from tests.fuzz.targets import imported, scratch
from tests.services.importers import sources

_INFO, _EPISODES = "meta/info.json", "meta/episodes.jsonl"


@cache
def _whole() -> Path:
    return sources.lerobot(scratch.folder() / "whole", "v2.1", video=False, episodes=1, fps=10)


@cache
def seeds() -> list[bytes]:
    info, episodes = ((_whole() / name).read_bytes() for name in (_INFO, _EPISODES))
    return [info + b"\n" + episodes, info.replace(b"v2.1", b"v3.0") + b"\n" + episodes]


def run(data: bytes) -> bool:
    dataset = scratch.folder() / "dataset"
    if not dataset.exists():
        shutil.copytree(_whole(), dataset)
    info, _, episodes = data.partition(b"\n")
    (dataset / _INFO).write_bytes(info)
    (dataset / _EPISODES).write_bytes(episodes)
    return imported.accepted("lerobot", dataset)


def mutate(data: bytes, rng: random.Random) -> bytes | None:
    """Change the JSON of a line."""
    lines = data.splitlines()
    if not lines:
        return None
    at = rng.randrange(len(lines))
    changed = trees.changed_json(lines[at], rng)
    return None if changed is None else b"\n".join([*lines[:at], changed.replace(b"\n", b""), *lines[at + 1 :]])

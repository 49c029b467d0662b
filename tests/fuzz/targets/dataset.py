"""``smal import lerobot`` of a data set's description."""

from functools import partial

from tests.fuzz.targets.imported import Lines
from tests.services.importers import sources

_SET = Lines(
    "lerobot",
    partial(sources.lerobot, version="v2.1", video=False, episodes=1, fps=10),
    ("meta/info.json", "meta/episodes.jsonl"),
    (b"v2.1", b"v3.0"),
)
seeds, run, mutate = _SET.seeds, _SET.run, _SET.mutate

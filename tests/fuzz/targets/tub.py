"""``smal import donkeycar`` of a tub's manifest and catalog."""

from functools import partial

from tests.fuzz.targets.imported import Lines
from tests.services.importers import sources

_TUB = Lines(
    "donkeycar",
    partial(sources.donkeycar, rate_hz=10.0),
    ("manifest.json", "catalog_0.catalog"),
    (b'"user/mode": "user", ', b""),
)
seeds, run, mutate = _TUB.seeds, _TUB.run, _TUB.mutate

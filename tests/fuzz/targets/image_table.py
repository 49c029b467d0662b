"""``smal import folder`` of its CSV file."""

from functools import partial

from tests.fuzz.targets.imported import Lines
from tests.services.importers import sources

_FOLDER = Lines("folder", partial(sources.csv_folder, rate_hz=10.0), ("drive.csv",), (b"x_m", b"episode"))
seeds, run, mutate = _FOLDER.seeds, _FOLDER.run, _FOLDER.mutate

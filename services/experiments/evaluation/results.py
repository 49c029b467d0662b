"""Results of an evaluation: an atomic file per unit, named by a digest of all that determines it."""

import json
import os
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

from services.experiments.engine import Engine
from services.experiments.evaluation.drivers import DriverError
from services.experiments.evaluation.units import Finding, Unit
from services.kit.errors import JobError, UsageError
from smal.files.container import replacing


class Results:
    """Results of some units: ``findings``, and their files in the folder ``work``."""

    def __init__(self, folder: Path, units: Sequence[Unit]) -> None:
        self.folder = folder
        self.work = folder / "units"
        self.work.mkdir(parents=True, exist_ok=True)
        self.findings: dict[Unit, Finding] = {
            unit: found for unit in units if (found := self._read(unit)) is not None
        }

    def _path(self, unit: Unit) -> Path:
        return self.work / f"{unit.name}.json"

    def _read(self, unit: Unit) -> Finding | None:
        path = self._path(unit)
        if not path.exists():
            return None
        try:
            found: Finding = json.loads(path.read_text(encoding="utf-8"))["finding"]
            missing = found.get("file") and not unit.file(self.work).exists()
        except (ValueError, LookupError, TypeError, AttributeError):
            raise JobError(f"{path}: invalid result; delete it to compute it again") from None
        return None if missing else found

    def add(self, unit: Unit, finding: Finding) -> None:
        """Save the result of a unit."""
        text = json.dumps({"unit": repr(unit), "finding": finding}, allow_nan=False) + "\n"
        with replacing(self._path(unit)) as file:
            file.write(text.encode())
        self.findings[unit] = finding

    def complete(
        self, units: Sequence[Unit], engine: Engine, progress: Callable[[int, int], object]
    ) -> list[str]:
        """Run the missing units on workers; return one line for each error of a driver.

        An error of a driver ends the searches of this driver that need the failed unit. Any other
        error ends the evaluation.
        """
        left = [unit for unit in units if unit not in self.findings]
        if left:
            self._check_shared(engine)  # Fails before anything is shown if there are no workers.
        progress(len(self.findings), len(units))
        failures: dict[str, None] = {}
        for unit, found in engine.graph(
            left, partial(timed, self.work.resolve()), lambda unit: unit.needs
        ):
            try:
                self.add(unit, found())
            except DriverError as error:
                failures[str(error)] = None
            except Exception as error:  # noqa: BLE001 - whatever it is, it is one line
                what = f"{type(unit).__name__.lower()} in {unit.site.world}"
                kind = "" if isinstance(error, JobError) else f"{type(error).__name__}: "
                raise JobError(
                    f"{what}: {kind}{' '.join(str(error).split())}; run the command again to "
                    "continue"
                ) from None
            progress(len(self.findings), len(units))
        return [*failures]

    def _check_shared(self, engine: Engine) -> None:
        """Raise UsageError if a remote worker cannot access the folder."""
        for worker, sees in engine.on_each(os.path.isdir, str(self.work.resolve())).items():
            if not sees:
                raise UsageError(
                    f"--out {self.folder}: not found at the worker {worker}; use a shared folder"
                )


def timed(folder: Path, unit: Unit) -> Finding:
    """Run a unit and measure its processor time."""
    began_s = time.process_time()
    found = unit.do(folder)
    return found | {"cpu_s": round(time.process_time() - began_s, 3)}

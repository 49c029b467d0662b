"""Results of an evaluation: a file for each unit, named by what determines it, that is there only when it is whole.

So an evaluation goes on where it was interrupted, plans share what they have in common, and what another version of the
code has found out is never taken for this one's.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from services.experiments.evaluation.units import Unit
from services.kit.errors import JobError
from smal.files.container import replacing

#: What a unit found out: numbers, texts, lists of them; ``cpu_s`` is the processor time that it took.
Finding = Mapping[str, Any]


def file_of(folder: Path, unit: Unit) -> Path:
    """Return the file that a unit leaves for others, if it leaves any: a drive, a model, pictures."""
    return folder / f"{unit.digest}.data"


class Results:
    """The results of some units: ``findings``, and in the folder ``work`` their files.

    Raises
    ------
    JobError
        A result cannot be read.
    """

    def __init__(self, folder: Path, units: Sequence[Unit]) -> None:
        self.folder, self.work = folder, folder / "units"
        self.work.mkdir(parents=True, exist_ok=True)
        self.findings: dict[Unit, Finding] = {unit: found for unit in units if (found := self._read(unit)) is not None}

    def _read(self, unit: Unit) -> Finding | None:
        path = self.work / f"{unit.digest}.json"
        if not path.exists():
            return None
        try:
            found: Finding = json.loads(path.read_text(encoding="utf-8"))["finding"]
        except (ValueError, LookupError, TypeError):
            raise JobError(f"{path}: is no result; delete it to have it made again") from None
        return found if not found.get("file") or file_of(self.work, unit).exists() else None

    def add(self, unit: Unit, finding: Finding) -> None:
        """Write what a unit found out."""
        text = json.dumps({"unit": unit.key, "finding": finding}, allow_nan=False) + "\n"
        with replacing(self.work / f"{unit.digest}.json") as file:
            file.write(text.encode())
        self.findings[unit] = finding

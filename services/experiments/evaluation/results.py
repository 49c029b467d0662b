"""Results of an evaluation in its folder, so that it goes on where it was interrupted.

Every finished unit of work is one line of ``units.jsonl``, written at once and never changed. What units leave for each
other (drives, models) lies in ``work``.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from services.experiments.evaluation.plan import Plan
from services.experiments.evaluation.schedule import Unit
from services.kit.errors import JobError, UsageError
from services.kit.version import program_version
from smal.features import FeatureSettings
from smal.files.container import replacing

#: What a unit found out: numbers, texts, lists of them.
Finding = Mapping[str, Any]
#: What holds our packages: a checkout, or where they are installed.
_PACKAGES: Final = Path(__file__).parents[3]
_PLAN, _UNITS, _WORK = "plan.json", "units.jsonl", "work"
# Whatever a result depends on; that the report is written differently invalidates nothing.
_SOURCES: Final = (
    "smal/**/*.py", "services/simulator/**/*", "services/robot/*.py", "services/expert/*.py",
    "services/experiments/evaluation/*.py",
)  # fmt: skip
_OF_NO_RESULT: Final = ("results.py", "worker_pool.py", "plan.py", "schedule.py")


def sources() -> list[Path]:
    """Return the code, the shaders and the worlds that the results depend on."""
    found = {path for pattern in _SOURCES for path in _PACKAGES.glob(pattern)}
    found -= {Path(__file__).with_name(name) for name in _OF_NO_RESULT}
    return sorted(path for path in found if path.is_file() and path.suffix != ".pyc")


def _code_fingerprint() -> str:
    digest = hashlib.sha256()
    for path in sources():
        digest.update(str(path.relative_to(_PACKAGES)).encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()[:12]


class ResultStore:
    """The folder of an evaluation.

    Parameters
    ----------
    folder
        Made if it does not exist.
    plan
        Whose results it holds.

    Raises
    ------
    UsageError
        It holds results of another plan, or of another version.
    JobError
        It cannot be read.
    """

    def __init__(self, folder: Path, plan: Plan) -> None:
        self.folder, self.work = folder, folder / _WORK
        self.work.mkdir(parents=True, exist_ok=True)
        self._check_plan(plan)
        self.findings: dict[str, Finding] = {}
        self._path = folder / _UNITS
        self._torn = False
        self._read()

    def _check_plan(self, plan: Plan) -> None:
        ours = {
            "plan": plan.name,
            "plan_fingerprint": plan.fingerprint,
            "version": program_version(),
            "features": FeatureSettings().fingerprint,
            "code": _code_fingerprint(),
        }
        path = self.folder / _PLAN
        if not path.exists():
            if (self.folder / _UNITS).exists():
                raise UsageError(f"--out {self.folder}: {_PLAN} is missing beside {_UNITS}; give another folder")
            with replacing(path) as file:
                file.write((json.dumps(ours, indent=2) + "\n").encode())
            return
        try:
            theirs = json.loads(path.read_text(encoding="utf-8"))
            other = [name for name, value in ours.items() if theirs[name] != value]
        except (ValueError, LookupError, TypeError):
            raise UsageError(f"--out {path}: is no plan of an evaluation; give another folder") from None
        if other:
            named = f"of the plan {theirs['plan']!r}" if "plan" in other else f"with another {other[0]}"
            raise UsageError(
                f"--out {self.folder}: holds results {named.replace('_', ' ')} ({theirs[other[0]]}, now "
                f"{ours[other[0]]}); give another folder"
            )

    def _read(self) -> None:
        """Read the lines but for a torn last one, of a program that was killed in writing it, or that is writing it."""
        if not self._path.exists():
            return
        with self._path.open("rb") as file:
            for number, line in enumerate(file, 1):
                if not line.endswith(b"\n"):
                    self._torn = True
                    break
                try:
                    entry = json.loads(line)
                    self.findings[entry["key"]] = entry["finding"]
                except (ValueError, LookupError, TypeError):
                    raise JobError(
                        f"{self._path}: line {number} is no result; delete it to have it made again"
                    ) from None

    def add(self, unit: Unit, finding: Finding, seconds: float) -> None:
        """Write what a unit found out; `seconds` of processor time it took."""
        if unit.key in self.findings:
            raise ValueError(f"{unit.key} is done already")
        kept = {**finding, "cpu_s": round(seconds, 3)}
        line = json.dumps({"key": unit.key, "finding": kept}, separators=(",", ":"), allow_nan=False)
        with self._path.open("ab") as file:
            if self._torn:
                file.truncate(self._path.read_bytes().rfind(b"\n") + 1)
                self._torn = False
            file.write(f"{line}\n".encode())
            file.flush()
            os.fsync(file.fileno())
        self.findings[unit.key] = kept

    def done(self, unit: Unit) -> bool:
        """Return whether a unit need not be run: its result is there, and the files that it left."""
        return unit.key in self.findings and all(
            (self.work / name).exists() for name in self.findings[unit.key].get("files", ())
        )

    def forget_missing(self, units: list[Unit]) -> None:
        """Have units whose files are gone run again, where something that is not done yet needs them."""
        wanted = {need for unit in units if unit.key not in self.findings for need in unit.needs}
        for unit in reversed(units):
            if unit.key in wanted:
                wanted.update(unit.needs if not self.done(unit) else ())
                if unit.key in self.findings and not self.done(unit):
                    del self.findings[unit.key]

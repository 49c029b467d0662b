"""``smal learn --add``: extend a model with its own runs and keep its earlier versions."""

import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, Final

from services.cli import options
from services.cli.lessons import save
from services.cli.outputs import writing
from services.experiments.words import remark
from services.kit.errors import JobError, UsageError
from services.recordings.dataset import Teacher
from smal.model import Model
from smal.teaching.demonstration import Use, whole_drives
from smal.teaching.map_update import Verdict, update_map

# Maximum number of earlier versions beside a model (NAME.smal.1, NAME.smal.2 …).
_KEPT: Final = 10


def versions(path: Path) -> list[Path]:
    """Return the earlier versions of a model, the oldest first."""
    found = [
        one
        for one in path.parent.glob(f"{path.name}.*")
        if one.name[len(path.name) + 1 :].isdecimal()
    ]
    return sorted(found, key=lambda one: int(one.name.rpartition(".")[2]))


def keep(path: Path) -> Path:
    """Save a copy of a model as its newest version; delete the oldest above the maximum."""
    before = versions(path)
    number = int(before[-1].name.rpartition(".")[2]) + 1 if before else 1
    kept = path.with_name(f"{path.name}.{number}")
    with writing(kept, "--out") as file, path.open("rb") as old:
        shutil.copyfileobj(old, file)
    for one in before[: max(len(before) + 1 - _KEPT, 0)]:
        one.unlink()
    return kept


def back(path: Path) -> Path:
    """Restore the newest earlier version of a model and return the path of that version."""
    before = versions(path)
    if not before:
        raise UsageError(f"{path}: earlier version not found")
    # A truncated version or a symbolic link must not replace a working model.
    if before[-1].is_symlink():
        raise UsageError(
            f"{before[-1]}: invalid version: a symbolic link; delete it to go back further"
        )
    options.loaded(before[-1], hint="; delete it to go back further")
    before[-1].replace(path)
    return before[-1]


def add_runs(files: list[Path], path: Path, bar: Callable[[str, int, int], None]) -> dict[str, Any]:
    """Extend the model at a path with runs and return the lines of the report."""
    model = options.loaded(path, "--out ", "; with --add it is the model to extend")
    if not isinstance(model, Model):
        raise UsageError(
            f"--out {path}: unsupported: a model of the paper's scheme cannot learn from runs"
        )
    teacher = Teacher(model.feature_settings, 2, include_runs=True, taught=model.mapped.size)
    teaching = teacher.read_all(files, bar)
    runs = []
    for drive in whole_drives(teaching.demonstrations):
        unfit = drive.unfit
        if drive.whole.goal not in model.mapped.goals:
            unfit = f"the model has no goal {drive.whole.goal}"
        if unfit:
            teaching.uses.append(Use(drive.name, drive.frames, 0, unfit))
        else:
            runs.append(drive.whole)
    remark(teaching.lines())
    try:
        new, verdict = update_map(model, runs, partial(bar, "following"))
    except ValueError as error:
        raise JobError(f"cannot learn from these runs: {error}") from None
    found: dict[str, Any] = {"runs": len(runs), "judged_by": len(runs[1::2])}
    if new is not model:
        found["before"] = str(keep(path))
        save(new, path)
    remark([_words(verdict)])
    return found | {
        "view_variants": len(new.mapped.variants),
        "gain": round(verdict.gain, 4),
        "least_gain": round(verdict.least, 4) if verdict.stretches > 1 else None,
        "false_goals": verdict.false_goals,
        "taken": verdict.better,
    }


def _words(verdict: Verdict) -> str:
    if not verdict.stretches:
        return "map unchanged: no unexpected view at a certain place"
    told = (
        f"{verdict.gain:+.2f} of evidence a frame (minimum {verdict.least:+.2f}) over "
        f"{verdict.stretches} stretches"
    )
    if verdict.better:
        return f"map extended with new view variants: {told}"
    wrong = f", {verdict.false_goals} early arrivals" * (verdict.false_goals > 0)
    return f"map unchanged: the held-back runs do not confirm the new view variants: {told}{wrong}"

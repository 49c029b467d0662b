"""``smal learn``: learn a map of views from recordings."""

import time
from dataclasses import replace
from typing import Annotated, Any

from typer import Option, echo

from services.cli import options
from services.cli.adding import add_runs
from services.cli.lessons import Lessons
from services.kit.errors import JobError, UsageError
from services.recordings.dataset import find_recordings
from smal.model import Model
from smal.teaching.mapping import learn as learn_map

_SHORTEST = 1  # Minimum length of a taught stretch without a gap, frames.


def learn(
    *,
    lessons: Lessons,
    add: Annotated[
        bool, Option("--add", help="Extension of the model at --out by its own runs.")
    ] = False,
    at_work: options.AtWork = options.HERE,
) -> None:
    """Learn a map of views from recorded drives.

    One successful drive is enough, by the scripted expert or by a person. Recovery drives, failed
    drives, collisions and the robot's own runs are left out. A table at the end lists the frames of
    each drive, the frames that teach, and the reason if a drive does not teach. Gaps in a drive are
    bridged by odometry, or by how much the views on both sides differ. Only camera, wheel odometry
    and applied commands are used, never true poses. `smal paper learn` learns the paper's model.

    The features are computed from the recorded images; --modalities accepts all but depth.

    With --add the model at --out is extended by two or more successful runs. If the robot was
    certain of its place and the view was unexpected, the place gets a view variant (maximum four).
    Every second run is held back; the extended map is kept only if the held-back runs are at least
    as likely in it. The previous model stays beside it as MODEL.1; `smal model back MODEL` restores
    it.

    Example: smal learn drives --out campus.smal

    Example: smal learn drives --modalities color,hog,apriltag --workers 2 --out campus.smal
    """
    began_s = time.perf_counter()
    lessons.check()
    if add:
        if lessons.modalities is not None:
            raise UsageError(
                "--modalities: unsupported with --add; the model at --out defines them"
            )
        with lessons.bars() as bars:
            added = add_runs(find_recordings(lessons.recordings), lessons.out, bars)
        lessons.report(added, began_s)
        return
    files, features = lessons.find()
    with lessons.bars() as bars, at_work.engine() as engine:
        teaching = lessons.taught(files, features, _SHORTEST, bars)
        try:
            model = learn_map(
                teaching.demonstrations,
                features,
                progress=bars,
                parallel=engine.map,
                report=teaching.uses.append,
            )
        except ValueError as error:
            raise JobError(f"cannot learn from these recordings: {error}") from None
    for goal in sorted({*model.mapped.goals} - {*model.appearances} - {*model.labels}):
        echo(
            f"{goal}: the end of the drive shows nothing particular; the robot reports it as found"
            " after it has tracked the way to its end",
            err=True,
        )
    model = replace(model, world=teaching.world)
    lessons.finish(model, _found(model), teaching, began_s)


def _found(model: Model) -> dict[str, Any]:
    """Return the rows of the report."""
    taught = model.mapped
    features = model.feature_settings
    found: dict[str, Any] = {
        "drives": taught.drive_count,
        "frames": len(taught.poses),
        "keyframes": len(taught.keyframes),
        "goals": ", ".join(sorted(set(taught.goals))),
    }
    if features.describing != features.modalities:
        # If the model uses detectors, report the target object of each goal.
        labels = {goal: found.label for goal, found in model.labels.items()}
        found["detected"] = {goal: labels.get(goal, "nothing") for goal in taught.goals}
    return found

"""``smal learn``: recordings in, a map of views out."""

import time
from typing import Annotated, Any

from typer import Option

from services.cli import options
from services.cli.adding import add_runs
from services.cli.lessons import Lessons
from services.kit.errors import JobError, UsageError
from services.recordings.dataset import find_recordings
from smal.model import Model
from smal.teaching.mapping import learn as learn_map

_SHORTEST = 2  # Frames without a gap that teach a way.


def learn(
    *,
    lessons: Lessons,
    add: Annotated[
        bool, Option("--add", help="Further learning of the model at --out, from its own runs.")
    ] = False,
    at_work: options.AtWork = options.HERE,
) -> None:
    """Learn the taught ways from recorded drives: a map of views.

    One drive that reached the victim is enough, by the scripted expert or by hand. Recovery drives, drives that did not
    reach the victim, collisions, and the robot's own runs teach nothing. Each omission is reported on standard error.
    Only camera, wheel odometry and applied commands are used, never true poses. The paper's model is learned by `smal
    paper learn`.

    The features are computed from the recorded images; --modalities may name any but depth.

    With --add the model at --out learns from runs that found the victim, two or more: where the robot was sure of its
    place though the view was unlike the taught one, the place gets a further look, four at most. Every second run is
    kept back, and the new map taken only if these are no less likely under it. The one before is kept beside it as
    MODEL.1 and so on; `smal model back MODEL` goes back.

    Example: smal learn drives --out campus.smal

    Example: smal learn drives --modalities color,hog,apriltag --workers 2 --out campus.smal
    """
    began_s = time.perf_counter()
    lessons.check()
    if add:
        if lessons.modalities is not None:
            raise UsageError(
                "--modalities: with --add the model at --out has its own; leave them out"
            )
        with lessons.bars() as bars:
            added = add_runs(find_recordings(lessons.recordings), lessons.out, bars)
        lessons.report(added, began_s)
        return
    files, features = lessons.find()
    with lessons.bars() as bars, at_work.engine() as engine:
        teaching = lessons.taught(files, features, _SHORTEST, bars)
        try:
            model = learn_map(teaching.demonstrations, features, progress=bars, parallel=engine.map)
        except ValueError as error:
            raise JobError(f"cannot learn from these recordings: {error}") from None
    lessons.finish(model, _found(model), teaching, began_s)


def _found(model: Model) -> dict[str, Any]:
    """Return what was learned, for the report."""
    taught = model.mapped
    features = model.feature_settings
    found: dict[str, Any] = {
        "drives": len(taught.goals),
        "frames": len(taught.poses),
        "keyframes": len(taught.keyframes),
        "goals": ", ".join(sorted(set(taught.goals))),
    }
    if features.describing != features.modalities:
        # Where detectors are asked for, which of the things that they find is sought.
        labels = {goal: word.label for goal, word in model.words.items()}
        found["detected"] = {goal: labels.get(goal, "nothing") for goal in taught.goals}
    return found

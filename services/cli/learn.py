"""``smal learn``: recordings in, a map of views out."""

import time
from contextlib import closing
from pathlib import Path
from typing import Annotated, Any

from typer import Argument, Option

from services.cli import options, outputs
from services.cli.adding import add_runs, save
from services.cli.lessons import check_out, taught_by, tell, tell_learned
from services.experiments.progress import Bars
from services.kit.errors import JobError, UsageError
from services.recordings.dataset import find_recordings
from smal.features import FeatureSettings
from smal.model import Model
from smal.teaching.mapping import learn as learn_map

_SHORTEST = 2  # Frames without a gap that teach a way.


def learn(
    recordings: Annotated[list[Path], Argument(help="Recordings (MCAP), or folders of them.")],
    out: Annotated[Path, Option(help="Where to write the model.")],
    modalities: options.Modalities = None,
    include_runs: Annotated[
        bool, Option(help="Learn also from runs in which the robot found the victim.")
    ] = False,
    add: Annotated[
        bool, Option("--add", help="Have the model at --out learn more from runs of its own.")
    ] = False,
    at_work: options.AtWork = options.HERE,
    json_file: options.JsonFile = None,
    progress: Annotated[
        bool, Option("--progress", help="Print progress as lines of JSON, for a program.")
    ] = False,
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
    check_out(out, json_file)
    if add:
        if modalities is not None:
            raise UsageError(
                "--add: the model at --out says by which features it learns; leave them out"
            )
        with closing(Bars(as_json=progress)) as bars:
            found = add_runs(find_recordings(recordings), out, bars)
        tell(found, out, began_s, json_file)
        return
    outputs.make_folder(out.parent, "--out")
    files = find_recordings(recordings)
    features = modalities or FeatureSettings()
    with closing(Bars(as_json=progress)) as bars, at_work.engine() as engine:
        teaching = taught_by(files, features, _SHORTEST, include_runs, bars)
        try:
            model = learn_map(teaching.demonstrations, features, progress=bars, parallel=engine.map)
        except ValueError as error:
            raise JobError(f"cannot learn from these recordings: {error}") from None
    save(model, out)
    tell_learned(_found(model), teaching, features, out, began_s, json_file)


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

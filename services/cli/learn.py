"""``smal learn``: recordings in, a model out."""

import time
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import typer
from typer import Argument, Option

from schemas.rpc import Scheme
from services.cli import options, outputs
from services.cli.adding import add_runs, save
from services.experiments.engine import Engine
from services.experiments.progress import Bars
from services.experiments.showing.summary import numbers_of
from services.experiments.words import counted, remark
from services.kit.errors import JobError, UsageError
from services.kit.model_service import AnyModel
from services.recordings.dataset import Teacher, Teaching, features_of_recordings, find_recordings
from smal.features import FeatureSettings
from smal.paper.learning import LearningSettings
from smal.paper.learning import learn as learn_paper
from smal.paper.reward import RewardError
from smal.paper.state_space import MemoryBoundError
from smal.teaching.mapping import learn as learn_map


def learn(
    recordings: Annotated[list[Path], Argument(help="Recordings (MCAP), or folders of them.")],
    out: Annotated[Path, Option(help="Where to write the model.")],
    length: Annotated[int | None, Option(min=1, help="Paper: frames of a sequence, l. [default: 5]")] = None,
    lambda1: Annotated[float | None, Option(help="Paper: of Eq. 7. [default: 0.1 sqrt(l)]")] = None,
    lambda2: Annotated[float | None, Option(help="Paper: of Eq. 7. [default: 0.1 sqrt(l)]")] = None,
    scheme: Annotated[Scheme, Option(help="filter: a map of views; paper: the paper's states and policy.")] = "filter",
    tau: Annotated[float | None, Option(min=0, max=1e6, help="Paper: of Eq. 8, a query frame. [default: 0.5]")] = None,
    gamma: Annotated[float | None, Option(help="Paper: discount factor. [default: 0.95]")] = None,
    modalities: options.Modalities = None,
    include_runs: Annotated[bool, Option(help="Learn also from runs in which the robot found the victim.")] = False,
    add: Annotated[bool, Option("--add", help="Have the model at --out learn more from runs of its own.")] = False,
    memory: Annotated[int | None, Option(min=1, metavar="MIB", help="Paper: stop rather than take more.")] = None,
    at_work: options.AtWork = options.HERE,
    json_file: options.JsonFile = None,
    progress: Annotated[bool, Option("--progress", help="Print progress as lines of JSON, for a program.")] = False,
) -> None:
    """Learn the taught ways from recorded drives: a map of views, or with --scheme paper the paper's model.

    One drive that reached the victim is enough, by the scripted expert or by hand. Recovery drives teach the paper's
    scheme alone; drives that did not reach the victim, collisions, and the robot's own runs teach nothing. What is left
    out of a recording is said on standard error. Only camera, wheel odometry and applied commands are used, never true
    poses.

    With --scheme paper --tau is the threshold of Eq. 8; --memory bounds templates and their inner products, 4 n (n + m)
    bytes for n template frames of m features.

    The modalities may be any of those in a recording. All but depth can also be computed from the recorded images; a
    map has no depth.

    With --add the model at --out learns from runs that found the victim, two or more: where the robot was sure of its
    place though the view was unlike the taught one, the place gets a further look, four at most. Every second run is
    kept back, and the new map taken only if these are no less likely under it. The one before is kept beside it as
    MODEL.1 and so on; `smal model back MODEL` goes back.

    Example: smal learn drives --out campus.smal

    Example: smal learn drives --modalities color,hog,apriltag --workers 2 --out campus.smal
    """
    began_s = time.perf_counter()
    given = {"length": length, "lambda1": lambda1, "lambda2": lambda2, "tau": tau, "gamma": gamma, "memory": memory}
    settings = _settings(scheme, {name: value for name, value in given.items() if value is not None})
    if out.is_dir():
        raise UsageError(f"--out {out}: is a folder; give the name of a file, for example {out / 'model.smal'}")
    outputs.check_file(json_file, "--json")
    if add:
        if scheme != "filter" or modalities is not None:
            raise UsageError("--add: the model at --out says by which scheme and features it learns; leave them out")
        with closing(Bars(as_json=progress)) as bars:
            found = add_runs(find_recordings(recordings), out, bars)
        _say(found, out, began_s, json_file)
        return
    outputs.make_folder(out.parent, "--out")
    files = find_recordings(recordings)
    features = _features(files, scheme, modalities)
    with closing(Bars(as_json=progress)) as bars, at_work.engine() as engine:
        teaching = _read(files, features, settings.sequence_length if scheme == "paper" else 2, include_runs, bars)
        model, found = _learn(teaching, scheme, replace(settings, features=features), bars, engine)
    save(model, out)
    used = {"recordings": teaching.recordings, "episodes": teaching.episodes, "remarks": teaching.remarks}
    chosen = {"modalities": features.modalities}
    recorded = f"{teaching.recordings} ({counted(teaching.episodes, 'episode')} used)"
    rows = {"recordings": recorded, "features": " ".join(features.modalities)} | found
    _say(rows, out, began_s, json_file, used | chosen | found)


def _say(
    rows: dict[str, Any], out: Path, began_s: float, json_file: Path | None, content: dict[str, Any] | None = None
) -> None:
    """Print what was found, and write it as JSON if that is wanted: the content, which is the rows if not given."""
    if json_file is not None:
        outputs.write_json(json_file, "--json", {"model": str(out)} | (rows if content is None else content))
    for name, value in (rows | {"seconds": f"{time.perf_counter() - began_s:.1f}", "model": out}).items():
        typer.echo(f"{name.replace('_', ' '):16}{value}")


def _settings(scheme: Scheme, given: dict[str, Any]) -> LearningSettings:
    """Return how the paper's scheme learns; refuse what only that has with another."""
    if scheme == "filter":
        for name, value in given.items():
            raise UsageError(f"--{name} {value}: only the paper's scheme has it; give --scheme paper")
    names = {"length": "sequence_length", "memory": "max_bytes"}
    chosen = {names.get(name, name): value for name, value in given.items()}
    if "max_bytes" in chosen:
        chosen["max_bytes"] *= 2**20
    try:
        return LearningSettings(**chosen)
    except ValueError as error:
        raise UsageError(str(error)) from None


def _features(files: list[Path], scheme: Scheme, modalities: FeatureSettings | None) -> FeatureSettings:
    """Return what is learned from: what is asked for, or what the recordings hold, of which a map takes no depth."""
    features = modalities or features_of_recordings(files)
    if scheme == "filter" and "depth" in features.needs:
        if modalities is not None:
            no_depth = "a map of views has no depth; leave depth out, or give --scheme paper"
            raise UsageError(f"--modalities {modalities.text}: {no_depth}")
        features = features.of_images() or FeatureSettings()
    return features


def _read(files: list[Path], features: FeatureSettings, shortest: int, include_runs: bool, bars: Bars) -> Teaching:
    teaching = Teacher(features, shortest, include_runs=include_runs).read_all(files, bars)
    bars.close()
    if not teaching.demonstrations and len(teaching.remarks) == 1:
        raise JobError(teaching.remarks[0])
    remark(teaching.remarks)
    if not teaching.demonstrations:
        raise JobError(f"nothing to learn from in {counted(len(files), 'recording')}, for the reasons above")
    return teaching


def _learn(
    teaching: Teaching, scheme: Scheme, settings: LearningSettings, bars: Bars, engine: Engine
) -> tuple[AnyModel, dict[str, Any]]:
    drives = teaching.demonstrations
    try:
        if scheme == "filter":
            mapped = learn_map(drives, settings.features, progress=bars, parallel=engine.map)
            taught = mapped.mapped
            # Where detectors are asked for, which of the things that they find is sought.
            words = {goal: mapped.words[goal].label if goal in mapped.words else "nothing" for goal in {*taught.goals}}
            return mapped, {
                "drives": len(taught.goals),
                "frames": len(taught.poses),
                "keyframes": len(taught.keyframes),
                "goals": ", ".join(sorted(set(taught.goals))),
            } | ({"detected": words} if settings.features.describing != settings.features.modalities else {})
        model = learn_paper(drives, settings, bars)
    except (ValueError, RewardError) as error:
        raise JobError(f"cannot learn from these recordings: {error}") from None
    except MemoryBoundError as error:
        raise JobError(f"--memory: {error}") from None
    lambda1, lambda2 = settings.lambdas
    return model, {
        "length": settings.sequence_length,
        "lambda1": lambda1,
        "lambda2": lambda2,
        "tau": settings.tau,
        "gamma": settings.gamma,
        **numbers_of(model),
    }

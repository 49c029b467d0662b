"""``smal learn``: recordings in, a model out."""

from __future__ import annotations

import json
import math
import sys
import time
from dataclasses import asdict, replace
from pathlib import Path
from typing import Annotated, NoReturn

import typer
from tqdm import tqdm

from schemas.rpc import Scheme
from services.cli import options, outputs
from services.cli.feature_options import ModalitiesOfRecordings, Weights, parse_features, with_weights
from services.experiments.matching.report import described_by
from services.kit.errors import JobError, UsageError
from services.recordings.dataset import Teacher, Teaching, find_recordings, states_shared_by_episodes
from services.recordings.recorded_features import features_of_recordings
from smal.features import FeatureSettings
from smal.paper.learning import LearningReport, LearningSettings
from smal.paper.learning import learn as learn_model
from smal.paper.model import Model, ModelError
from smal.paper.novelty import WeightTest
from smal.paper.reward import RewardError
from smal.paper.template_store import MemoryBoundError


def learn(
    recordings: Annotated[list[Path], typer.Argument(help="Recordings (MCAP), or folders of them.")],
    out: Annotated[Path, typer.Option(help="Where to write the model.")],
    length: Annotated[int | None, typer.Option(min=1, help="Frames of a sequence, l. [default: 5]")] = None,
    lambda1: Annotated[float | None, typer.Option(help="Of Eq. 7. [default: 0.1 sqrt(l)]")] = None,
    lambda2: Annotated[float | None, typer.Option(help="Of Eq. 7. [default: 0.1 sqrt(l)]")] = None,
    scheme: options.SchemeOption = "filter",
    tau: Annotated[
        float | None,
        typer.Option(help="The paper's test for new states (Eq. 8), with this threshold for each query frame."),
    ] = None,
    gamma: Annotated[float | None, typer.Option(help="Discount factor. [default: 0.95]")] = None,
    modalities: ModalitiesOfRecordings = None,
    weights: Weights = None,
    include_runs: Annotated[
        bool, typer.Option(help="Learn also from runs in which the robot found the victim.")
    ] = False,
    memory: Annotated[
        int | None,
        typer.Option(
            min=1,
            metavar="MIB",
            help="Stop, rather than take more memory than this for templates and their inner products: 4 n (n + m) "
            "bytes for n template frames of m features. [default: no limit]",
        ),
    ] = None,
    json_file: Annotated[Path | None, typer.Option("--json", help="Write the report as JSON.")] = None,
    progress: Annotated[
        bool, typer.Option("--progress", help="Print progress as lines of JSON, for a program that waits.")
    ] = False,
) -> None:
    """Learn a map of views, and the paper's states, actions, transitions, reward and policy, from recorded drives.

    One drive that reached the victim is enough, by the scripted expert or by hand. Recovery drives add to the paper's
    part alone; drives that did not reach the victim, collisions, and the robot's own runs teach nothing. What is left
    out of a recording is said on standard error. Only camera, wheel odometry and applied commands are used, never true
    poses. With --scheme paper only the paper's part is learned, with its test for new states.

    Of the modalities in a recording any can be learned from. All but depth can also be computed from the recorded
    images.

    Example: smal learn drives --out campus.smal --length 5
    """
    began_s = time.perf_counter()
    settings = _settings(length, lambda1, lambda2, _tau(scheme, tau), gamma)
    settings = replace(settings, map_views=scheme == "filter")
    if memory is not None:
        settings = replace(settings, max_bytes=memory * 2**20)
    if out.is_dir():
        raise UsageError(f"--out {out}: is a folder; give the name of a file, for example {out / 'model.smal'}")
    outputs.make_folder(out.parent, "--out")
    outputs.check_file(json_file, "--json")
    files = find_recordings(recordings)
    settings = replace(settings, features=_features(files, modalities, weights))
    bar = _Lines() if progress else _StageBar()
    try:
        teaching = _read(files, settings, include_runs, bar)
        model, report = _learn(teaching, settings, bar)
    finally:
        bar.close()
    try:
        model.save(out)
        if json_file is not None:
            outputs.write_json(json_file, "--json", _as_json(teaching, settings, report, out))
    except ModelError as error:
        raise JobError(str(error)) from None
    except OSError as error:
        raise JobError(f"cannot write {error.filename or out}: {error.strerror}") from None
    typer.echo(_as_text(teaching, settings, report, out, time.perf_counter() - began_s))


def _tau(scheme: Scheme, tau: float | None) -> float | None:
    """Return the threshold of Eq. 8, which the paper's scheme always goes by."""
    return WeightTest().tau if tau is None and scheme == "paper" else tau


def _settings(
    length: int | None, lambda1: float | None, lambda2: float | None, tau: float | None, gamma: float | None
) -> LearningSettings:
    given: dict[str, object] = {"sequence_length": length, "lambda1": lambda1, "lambda2": lambda2, "gamma": gamma}
    chosen = {name: value for name, value in given.items() if value is not None}
    if tau is not None and not (math.isfinite(tau) and tau >= 0.0):
        raise UsageError(f"--tau must be finite and not negative, got {tau}")
    if tau is not None:
        chosen |= {"novelty": "weight", "novelty_parameters": {"tau": tau}}
    try:
        return LearningSettings(**chosen)  # type: ignore[arg-type]  # checked by LearningSettings
    except ValueError as error:
        raise UsageError(str(error)) from None


def _features(files: list[Path], modalities: str | None, weights: str | None) -> FeatureSettings:
    if modalities is not None:
        return parse_features(modalities, weights)
    features = features_of_recordings(files)
    return features if weights is None else with_weights(features, weights)


class _Lines:
    """Says how far it is, a line for each percent."""

    def __init__(self) -> None:
        self._said: tuple[str, int] | None = None

    def __call__(self, stage: str, done: int, total: int) -> None:
        now = (stage, 100 * done // max(total, 1))
        if now != self._said:
            self._said = now
            sys.stdout.write(json.dumps({"stage": stage, "done": done, "total": total}) + "\n")
            sys.stdout.flush()

    def close(self) -> None:
        """Have nothing to end."""


class _StageBar:
    """A progress bar that begins anew with every stage."""

    def __init__(self) -> None:
        self._bar: tqdm[NoReturn] | None = None
        self._stage = ""

    def __call__(self, stage: str, done: int, total: int) -> None:
        bar = self._bar
        if bar is None or stage != self._stage:
            self.close()
            # disable=None: no bars in a log file or a pipe, where the remarks would drown in them.
            bar = tqdm(desc=stage, dynamic_ncols=True, disable=None)
            self._stage, self._bar = stage, bar
        bar.total = total
        bar.update(done - bar.n)

    def close(self) -> None:
        if self._bar is not None:
            self._bar.close()
            self._bar = None


def _read(files: list[Path], settings: LearningSettings, include_runs: bool, bar: _Lines | _StageBar) -> Teaching:
    teacher = Teacher(settings.features, settings.sequence_length, include_runs=include_runs)
    for number, path in enumerate(files):
        bar("reading", number, len(files))
        teacher.read(path)
    bar("reading", len(files), len(files))
    bar.close()
    teaching = teacher.teaching
    if not teaching.demonstrations and len(teaching.remarks) == 1:
        raise JobError(teaching.remarks[0])
    for remark in teaching.remarks:
        sys.stderr.write(f"smal: {remark}\n")
    if not teaching.demonstrations:
        raise JobError(f"nothing to learn from in {len(files)} recordings, for the reasons above")
    return teaching


def _learn(teaching: Teaching, settings: LearningSettings, bar: _Lines | _StageBar) -> tuple[Model, LearningReport]:
    try:
        model, report = learn_model(teaching.demonstrations, settings, bar)
    except (ValueError, RewardError) as error:
        raise JobError(f"cannot learn from these recordings: {error}") from None
    except MemoryBoundError as error:
        raise JobError(f"--memory: {error}") from None
    return model, replace(report, shared_states=states_shared_by_episodes(model))


def _as_text(teaching: Teaching, settings: LearningSettings, report: LearningReport, out: Path, seconds: float) -> str:
    rows = {
        "recordings": f"{teaching.recordings} ({teaching.episodes} episodes used)",
        "frames": report.frames,
        "features": described_by(settings.features),
        "keyframes": f"{report.keyframes} of the map of views" if report.keyframes else "none: no map of views",
        "states": report.states,
        "shared states": f"{report.shared_states} (seen in at least two episodes)",
        "actions": report.actions,
        "goal states": report.goals,
        "memory": f"{report.template_bytes / 2**20:.0f} MiB for templates and their inner products",
        "seconds": f"{seconds:.1f}",
        "model": out,
    }
    return "\n".join(f"{name:14}{value}" for name, value in rows.items())


def _as_json(teaching: Teaching, settings: LearningSettings, report: LearningReport, out: Path) -> dict[str, object]:
    lambda1, lambda2 = settings.lambdas
    return {
        "model": str(out),
        "recordings": teaching.recordings,
        "episodes": teaching.episodes,
        "remarks": teaching.remarks,
        "modalities": settings.features.modalities,
        "weights": settings.features.weights,
        "length": settings.sequence_length,
        "lambda1": lambda1,
        "lambda2": lambda2,
        "gamma": settings.gamma,
        "novelty": settings.novelty,
        **asdict(report),
    }

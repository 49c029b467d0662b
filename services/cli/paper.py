"""``smal paper``: the paper's scheme."""

import time
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import typer
from typer import Argument, Option

from services.cli import options, outputs
from services.cli.adding import save
from services.cli.grouping import STYLE
from services.cli.lessons import check_out, taught_by, tell_learned
from services.experiments.progress import Bars
from services.experiments.showing.summary import numbers_of
from services.kit.errors import JobError, UsageError
from services.recordings.dataset import find_recordings
from smal.features import FeatureSettings
from smal.paper.learning import LearningSettings
from smal.paper.learning import learn as learn_paper
from smal.paper.model import PaperModel
from smal.paper.reward import RewardError
from smal.paper.state_space import MemoryBoundError

app = typer.Typer(
    help="The paper's scheme.\n\nExample: smal paper learn drives --out paper.smal", **STYLE
)


@app.callback()
def paper() -> None:
    """Learn by the paper's scheme."""


@app.command("learn")
def learn(
    recordings: Annotated[list[Path], Argument(help="Recordings (MCAP), or folders of them.")],
    out: Annotated[Path, Option(help="Where to write the model.")],
    length: Annotated[
        int | None, Option(min=1, help="Frames of a sequence, l. [default: 5]")
    ] = None,
    lambda1: Annotated[float | None, Option(help="Of Eq. 7. [default: 0.1 sqrt(l)]")] = None,
    lambda2: Annotated[float | None, Option(help="Of Eq. 7. [default: 0.1 sqrt(l)]")] = None,
    tau: Annotated[
        float | None, Option(min=0, max=1e6, help="Of Eq. 8, a query frame. [default: 0.5]")
    ] = None,
    gamma: Annotated[float | None, Option(help="Discount factor. [default: 0.95]")] = None,
    memory: Annotated[
        int | None, Option(min=1, metavar="MIB", help="Stop rather than take more memory.")
    ] = None,
    modalities: options.Modalities = None,
    include_runs: Annotated[
        bool, Option(help="Learn also from runs in which the robot found the victim.")
    ] = False,
    json_file: options.JsonFile = None,
    progress: Annotated[
        bool, Option("--progress", help="Print progress as lines of JSON, for a program.")
    ] = False,
) -> None:
    """Learn the paper's states, actions, reward and policy from recorded drives; `smal run` runs it as any model.

    Recovery drives teach as well. --tau is the threshold of Eq. 8; --memory bounds templates and their inner products,
    4 n (n + m) bytes for n template frames of m features.

    Example: smal paper learn drives --out paper.smal

    Example: smal paper learn drives --length 10 --tau 0.4 --out paper.smal
    """
    began_s = time.perf_counter()
    given = {
        "sequence_length": length,
        "lambda1": lambda1,
        "lambda2": lambda2,
        "tau": tau,
        "gamma": gamma,
        "max_bytes": None if memory is None else memory * 2**20,
    }
    settings = _settings({name: value for name, value in given.items() if value is not None})
    check_out(out, json_file)
    outputs.make_folder(out.parent, "--out")
    files = find_recordings(recordings)
    features = modalities or FeatureSettings()
    with closing(Bars(as_json=progress)) as bars:
        teaching = taught_by(files, features, settings.sequence_length, include_runs, bars)
        try:
            model = learn_paper(teaching.demonstrations, replace(settings, features=features), bars)
        except (ValueError, RewardError) as error:
            raise JobError(f"cannot learn from these recordings: {error}") from None
        except MemoryBoundError as error:
            raise JobError(f"--memory: {error}") from None
    save(model, out)
    tell_learned(_found(model, settings), teaching, features, out, began_s, json_file)


def _settings(given: dict[str, Any]) -> LearningSettings:
    try:
        return LearningSettings(**given)
    except ValueError as error:
        raise UsageError(str(error)) from None


def _found(model: PaperModel, settings: LearningSettings) -> dict[str, Any]:
    """Return what was learned, for the report."""
    lambda1, lambda2 = settings.lambdas
    return {
        "length": settings.sequence_length,
        "lambda1": lambda1,
        "lambda2": lambda2,
        "tau": settings.tau,
        "gamma": settings.gamma,
        **numbers_of(model),
    }

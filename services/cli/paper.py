"""``smal paper``: the paper's scheme."""

import time
from dataclasses import asdict, dataclass
from typing import Annotated, Any, Final

import typer
from typer import Option

from services.cli.grouping import STYLE, grouped
from services.cli.lessons import Lessons
from services.experiments.showing.summary import numbers_of
from services.kit.errors import JobError, UsageError
from smal.features import FeatureSettings
from smal.paper.learning import LearningSettings
from smal.paper.learning import learn as learn_paper
from smal.paper.model import PaperModel
from smal.paper.reward import RewardError
from smal.paper.state_space import MemoryBoundError
from smal.teaching.demonstration import Use, whole_drives

app = typer.Typer(
    help="The paper's scheme.\n\nExample: smal paper learn drives --out paper.smal", **STYLE
)


@app.callback()
def paper() -> None:
    """Learn by the paper's scheme."""


_USUAL: Final = LearningSettings()


@dataclass(frozen=True)
class Settings:
    """Settings of the paper's scheme."""

    sequence_length: Annotated[
        int, Option("--length", min=1, help="Sequence length l, frames.")
    ] = _USUAL.sequence_length
    lambda1: Annotated[float | None, Option(help="λ1 of Eq. 7. [default: 0.1 sqrt(l)]")] = None
    lambda2: Annotated[float | None, Option(help="λ2 of Eq. 7. [default: 0.1 sqrt(l)]")] = None
    tau: Annotated[float, Option(min=0, max=1e6, help="Threshold of Eq. 8 per query frame.")] = (
        _USUAL.tau
    )
    gamma: Annotated[float, Option(help="Discount factor.")] = _USUAL.gamma
    max_mib: Annotated[
        int | None, Option("--memory", min=1, metavar="MIB", help="Maximum memory; see above.")
    ] = None

    def of(self, features: FeatureSettings = _USUAL.features) -> LearningSettings:
        """Return these settings with features; raise UsageError if one is invalid."""
        given = asdict(self)
        mib = given.pop("max_mib")
        try:
            return LearningSettings(features, **given, max_bytes=mib and mib * 2**20)
        except ValueError as error:
            raise UsageError(str(error)) from None


def learn(*, lessons: Lessons, settings: Settings) -> None:
    """Learn the paper's states, actions, reward and policy from recorded drives.

    `smal run` accepts the model. Recovery drives teach as well. --tau is the threshold of Eq. 8.
    --memory limits templates and their inner products: 4 n (n + m) bytes for n template frames of m
    features.

    Example: smal paper learn drives --out paper.smal

    Example: smal paper learn drives --length 10 --tau 0.4 --out paper.smal
    """
    began_s = time.perf_counter()
    settings.of()
    lessons.check()
    files, features = lessons.find()
    chosen = settings.of(features)
    with lessons.bars() as bars:
        teaching = lessons.taught(files, features, chosen.sequence_length, bars)
        try:
            model = learn_paper(teaching.demonstrations, chosen, bars)
        except (ValueError, RewardError) as error:
            raise JobError(f"cannot learn from these recordings: {error}") from None
        except MemoryBoundError as error:
            raise JobError(f"--memory: {error}") from None
    for drive in whole_drives(teaching.demonstrations):
        teaching.uses.append(Use(drive.name, drive.frames, drive.frames))
    lessons.finish(model, _found(model, chosen), teaching, began_s)


app.command("learn")(grouped(learn))


def _found(model: PaperModel, settings: LearningSettings) -> dict[str, Any]:
    """Return the rows of the report."""
    lambda1, lambda2 = settings.lambdas
    return {
        "length": settings.sequence_length,
        "lambda1": lambda1,
        "lambda2": lambda2,
        "tau": settings.tau,
        "gamma": settings.gamma,
        **numbers_of(model),
    }

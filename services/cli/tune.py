"""``smal tune``: weights, length, penalty and threshold for ``smal match`` and ``smal learn``."""

from __future__ import annotations

import math
import time
from pathlib import Path
from typing import Annotated, Final, NoReturn

import typer
from tqdm import tqdm

from services.cli import outputs
from services.cli.feature_options import parse_features
from services.cli.match_settings import check_length
from services.experiments.matching.image_folder import list_folder
from services.experiments.tuning.problem import Problem, labelled, unlabelled, with_threshold
from services.experiments.tuning.report import Report, as_json, as_text
from services.kit.errors import JobError, UsageError
from smal.features import MODALITIES, MODALITY_NAMES, FeatureSettings
from smal.place_recognition.methods import METHODS, MatchSettings, Method
from smal.tuning.recommendation import Tuning
from smal.tuning.recommendation import tune as tune_settings
from smal.tuning.setting_search import SearchSpace

_CANDIDATES: Final = ", ".join(name for name in MODALITY_NAMES if name != "depth")
_PENALTIES: Final = (0.2, 0.35, 0.5, 0.65, 0.8)
#: a in lambda1 = lambda2 = a sqrt(l); above 0.2 the scores of `paper` collapse.
_LAMBDA_SCALES: Final = (0.05, 0.07, 0.1, 0.14, 0.2)


def tune(
    reference_dir: Annotated[
        Path, typer.Argument(metavar="REFERENCE_DIR", help="Folder with the images of the traverse that is known.")
    ],
    query_dir: Annotated[
        Path | None,
        typer.Argument(metavar="QUERY_DIR", help="Folder with the images of another traverse, labelled by --truth."),
    ] = None,
    truth: Annotated[
        Path | None,
        typer.Option(metavar="CSV", help="What is right: columns query, reference_first, reference_last, from 0."),
    ] = None,
    method: Annotated[str, typer.Option(metavar="NAME", help="smal, image, nearest or paper.")] = "smal",
    modalities: Annotated[
        str | None,
        typer.Option(
            metavar="NAMES",
            help=f"Candidates, separated by commas, out of {_CANDIDATES}. [default: all of colour images]",
        ),
    ] = None,
    length: Annotated[
        int | None,
        typer.Option(
            min=1, help="Frames of a window, l. [default: searched with --truth, else the method's]", show_default=False
        ),
    ] = None,
    precision: Annotated[
        float, typer.Option(help="Of the answers above tau, above 0 and at most 1: with 1, all must be right.")
    ] = 1.0,
    seed: Annotated[int, typer.Option(min=0, help="Of the degradation and of the bootstrap.")] = 0,
    json_file: Annotated[Path | None, typer.Option("--json", metavar="FILE", help="Write the results as JSON.")] = None,
) -> None:
    """Choose modalities, weights, window, penalty and threshold, and say whether they beat the defaults.

    With QUERY_DIR and --truth the settings with the largest area under the precision-recall curve are searched on one
    half of the queries and tested on the other, then the other way round. The defaults are recommended unless the
    tuned settings are better on the half that did not choose, by more than chance (95 % bootstrap interval).

    With REFERENCE_DIR alone there are no labels. Every second frame then is a query and the others are references, so
    that the right answer is known: the frames beside it. Undegraded, every setting finds it; so the queries are shown
    under another light and from beside, in two ways, at the least strength that some do not survive. This stands for
    another traverse and is none. Modalities, weights and penalty are chosen by single frames, since a sequence hides
    what its frames lack, on one half under one of the two conditions, and tested on the other half under the other.
    The length is not searched. tau is chosen by windows, with the middle third of the references taken away: of the
    queries there, every answer is wrong.

    With --method paper the answer is also for smal learn: its lambda1 and lambda2, and tau per query frame.

    The JSON has the settings that were "recommended", all that were "tried" and their "auc", the "held_out" figures
    (value and 95 % interval) and the "threshold" tau with its precision and recall.

    Example: smal tune summer winter --truth truth.csv --json tuned.json
    """
    began_s = time.perf_counter()
    chosen = _method(method)
    default, held = _features(chosen, modalities)
    if not (math.isfinite(precision) and 0.0 < precision <= 1.0):
        raise UsageError(f"--precision {precision:g}: must be above 0 and at most 1")
    check_length(method, chosen, length)
    length = length if chosen.any_length else chosen.length
    _check_pair(query_dir, truth)
    folders = (reference_dir,) if query_dir is None else (reference_dir, query_dir)
    outputs.check_file(json_file, "--json", () if truth is None else (truth,), folders)
    start = MatchSettings(default, chosen.length if length is None else length, chosen.penalty)
    references = list_folder(reference_dir, "REFERENCE_DIR")
    problem = (
        unlabelled(method, references, held, start, seed)
        if query_dir is None or truth is None
        else labelled(method, references, list_folder(query_dir, "QUERY_DIR"), held, start, truth, length is None)
    )
    read_s = time.perf_counter()
    tuning = _tune(problem, _space(method, chosen, held, problem), precision, seed)
    tuning = with_threshold(problem, method, tuning, precision)
    seconds = {"reading": read_s - began_s, "searching": time.perf_counter() - read_s}
    report = Report(
        method, reference_dir, query_dir, truth, problem.unlabelled, modalities is not None, precision, tuning, seconds
    )
    if json_file is not None:
        outputs.write_json(json_file, "--json", as_json(report))
    for line in as_text(report, json_file):
        typer.echo(line)


def _method(name: str) -> Method:
    known = [one for one, method in METHODS.items() if method.any_features]
    if name not in METHODS:
        raise UsageError(f"--method {name}: unknown; known are {', '.join(known)}")
    if name not in known:
        raise UsageError(f"--method {name}: has nothing to tune; known are {', '.join(known)}")
    return METHODS[name]


def _features(method: Method, modalities: str | None) -> tuple[FeatureSettings, FeatureSettings]:
    """Return the default features, and the candidates, of which those of the default come first."""
    if modalities is not None:
        features = parse_features(modalities)
        if "depth" in features.needs:
            raise UsageError(f"--modalities {modalities}: depth cannot be tuned; give modalities of colour images")
        return features, features
    names = [name for name, modality in MODALITIES.items() if modality.needs == "color"]
    others = [name for name in names if name not in method.features.modalities]
    return method.features, FeatureSettings.of((*method.features.modalities, *others))


def _check_pair(query_dir: Path | None, truth: Path | None) -> None:
    if query_dir is None and truth is not None:
        raise UsageError(f"--truth {truth}: is about queries; give QUERY_DIR as well")
    if query_dir is not None and truth is None:
        raise UsageError(f"QUERY_DIR {query_dir}: needs --truth; without labels give REFERENCE_DIR alone")


def _space(name: str, method: Method, held: FeatureSettings, problem: Problem) -> SearchSpace:
    penalties = () if method.penalty is None else _LAMBDA_SCALES if name == "paper" else _PENALTIES
    return SearchSpace(held.modalities, problem.lengths, penalties)


def _tune(problem: Problem, space: SearchSpace, precision: float, seed: int) -> Tuning:
    with tqdm(desc="trying settings", unit="setting", dynamic_ncols=True, disable=None) as bar:
        try:
            return tune_settings(
                problem.trials,
                problem.start,
                space,
                lambda done, total: _advance(bar, done, total),
                precision=precision,
                seed=seed,
            )
        except ValueError as error:
            raise JobError(f"cannot tune on these folders: {error}") from None
        except MemoryError:
            raise JobError("tuning on these folders takes more memory than there is") from None


def _advance(bar: tqdm[NoReturn], done: int, total: int) -> None:
    bar.total = total
    bar.update(done - bar.n)

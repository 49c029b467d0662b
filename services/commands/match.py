"""``smal match``: which frame of one image folder shows the place of each frame of another."""

from __future__ import annotations

import json
import math
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Final, NoReturn

import typer
from tqdm import tqdm

from services.commands import options
from services.commands.errors import JobError, UsageError
from services.commands.feature_options import parse_features, with_weights
from services.commands.image_folder import ImageFolder, describe_frames, list_folder, read_truth_of, say_skipped
from services.commands.match_report import Quality, Result, Traverses, as_json, as_text, described_by
from smal.container import replacing
from smal.evaluation.ground_truth import IntervalTruth, judge
from smal.evaluation.precision_recall import PrecisionRecall, block_length, bootstrap_intervals
from smal.features import MODALITY_NAMES, FeatureSettings
from smal.place_recognition import Matches
from smal.place_recognition.methods import METHODS, MatchSettings, Method

_PLOT_FORMATS: Final = (".png", ".svg", ".pdf")
_METHODS: Final = "; ".join(f"{name}: {method.meaning}" for name, method in METHODS.items())


def _defaults(of: Callable[[Method], object]) -> str:
    """Say in one bracket what every method does unless told otherwise; those that have nothing are left out."""
    names: dict[str, list[str]] = {}
    for name, method in METHODS.items():
        if of(method) is not None:
            names.setdefault(str(of(method)), []).append(name)
    said = "; ".join(f"{value} ({', '.join(those)})" for value, those in names.items())
    return f"[default: {said}]"


_DEFAULT_LENGTHS: Final = _defaults(lambda method: method.length)
_DEFAULT_PENALTIES: Final = _defaults(lambda method: method.penalty)
_DEFAULT_MODALITIES: Final = _defaults(lambda method: ",".join(method.features.modalities))


def match(
    reference_dir: Annotated[
        Path, typer.Argument(metavar="REFERENCE_DIR", help="Folder with the images of the traverse that is known.")
    ],
    query_dir: Annotated[
        Path, typer.Argument(metavar="QUERY_DIR", help="Folder with the images of the traverse to be recognised.")
    ],
    method: Annotated[str, typer.Option(metavar="NAME", help=f"How places are recognised. {_METHODS}.")] = "smal",
    length: Annotated[
        int | None, typer.Option(min=1, help=f"Frames of a window, l. {_DEFAULT_LENGTHS}", show_default=False)
    ] = None,
    modalities: Annotated[
        str | None,
        typer.Option(
            metavar="NAMES",
            help=f"Feature modalities, separated by commas, out of {', '.join(MODALITY_NAMES)}. {_DEFAULT_MODALITIES}",
        ),
    ] = None,
    weights: Annotated[
        str | None,
        typer.Option(
            metavar="NUMBERS",
            help="How much each modality counts: as many, separated by commas, in their order. [default: all the same]",
        ),
    ] = None,
    penalty: Annotated[
        float | None,
        typer.Option(
            help="Weight of the regularisation, above 0 and below 1 (smal and image: as a share of the one for which "
            f"nothing matches; paper: a in lambda1 = lambda2 = a sqrt(l)). {_DEFAULT_PENALTIES}",
            show_default=False,
        ),
    ] = None,
    tau: Annotated[
        float | None,
        typer.Option(
            help="Leave out matches with a score of at most this; --truth then judges what is left. [default: keep all]"
        ),
    ] = None,
    reference_depth: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="For the modality depth: 16-bit images in millimetres, one for each image of REFERENCE_DIR, in the "
            "same order.",
        ),
    ] = None,
    query_depth: Annotated[
        Path | None, typer.Option(metavar="DIR", help="The same for the images of QUERY_DIR.")
    ] = None,
    truth: Annotated[
        Path | None,
        typer.Option(
            metavar="CSV",
            help="What is right: columns query, reference_first, reference_last, with frames counted from 0 and the "
            "last included. Adds the area under the precision-recall curve (AUC) and the recall at 100 % precision.",
        ),
    ] = None,
    json_file: Annotated[Path | None, typer.Option("--json", metavar="FILE", help="Write the matches as JSON.")] = None,
    plot: Annotated[
        Path | None, typer.Option(metavar="FILE.png", help="Draw the matches; with --truth also precision and recall.")
    ] = None,
) -> None:
    """Find for every image of one folder the image of another that was taken at the same place.

    Frames are a folder's images in natural order (img2 before img10), counted from 0. Any format and size that OpenCV
    reads will do, grey or with 16 bits as well. An image that cannot be read is skipped and keeps its number.

    Every query frame gets a match as soon as a window of --length frames ends there: the first ones get none. Scores
    are at least 0, or at least -1 with nearest; a higher one is a surer match, comparable within one run only. In the
    JSON a frame without a match has the reference null and the score 0.

    Example: smal match summer winter --length 10 --truth truth.csv --json matches.json --plot matches.png
    """
    chosen = _method(method)
    features = _features(method, chosen, modalities, weights)
    settings = MatchSettings(features, _length(method, chosen, length), _penalty(method, chosen, penalty))
    if tau is not None and not math.isfinite(tau):
        raise UsageError(f"--tau {tau}: must be finite")
    folders = (reference_dir, query_dir, reference_depth, query_depth)
    _check_outputs(json_file, plot, truth, [folder for folder in folders if folder is not None])
    references, queries = list_folder(reference_dir, "REFERENCE_DIR"), list_folder(query_dir, "QUERY_DIR")
    depths = _depths(features, references, queries, reference_depth, query_depth)
    expected = None if truth is None else read_truth_of(truth, queries, references)
    began_s = time.perf_counter()
    traverses = Traverses(
        references,
        queries,
        describe_frames(references, features, depths[0], "reading references"),
        describe_frames(queries, features, depths[1], "reading queries"),
    )
    read_s = time.perf_counter()
    _say_skipped(traverses, settings.length)
    found = _match(chosen, traverses, settings)
    matches = traverses.in_folders(found if tau is None else found.surer_than(tau))
    seconds = {"reading": read_s - began_s, "matching": time.perf_counter() - read_s}
    quality = None if expected is None else _quality(matches, expected, settings.length)
    result = Result(method, settings, traverses, matches, quality, seconds)
    if json_file is not None:
        with replacing(json_file) as file:
            file.write((json.dumps(as_json(result), indent=2) + "\n").encode())
    if plot is not None:
        _draw(plot, result, expected)
    for line in as_text(result, [path for path in (json_file, plot) if path is not None]):
        typer.echo(line)


def _method(name: str) -> Method:
    if name not in METHODS:
        raise UsageError(f"--method {name}: unknown; known are {', '.join(METHODS)}")
    return METHODS[name]


def _length(name: str, method: Method, length: int | None) -> int:
    if length not in (None, method.length) and not method.any_length:
        raise UsageError(f"--length {length}: the method {name} is made for {method.length}")
    return method.length if length is None else length


def _penalty(name: str, method: Method, penalty: float | None) -> float | None:
    if penalty is None:
        return method.penalty
    if method.penalty is None:
        raise UsageError(f"--penalty {penalty:g}: the method {name} has none")
    if not 0.0 < penalty < 1.0:
        raise UsageError(f"--penalty {penalty:g}: must be above 0 and below 1")
    return penalty


def _features(name: str, method: Method, modalities: str | None, weights: str | None) -> FeatureSettings:
    if not method.any_features and (modalities is not None or weights is not None):
        flag = f"--modalities {modalities}" if modalities is not None else f"--weights {weights}"
        raise UsageError(f"{flag}: the method {name} has its own features, {', '.join(method.features.modalities)}")
    if modalities is not None:
        return parse_features(modalities, weights)
    return method.features if weights is None else with_weights(method.features, weights)


def _check_outputs(json_file: Path | None, plot: Path | None, truth: Path | None, folders: list[Path]) -> None:
    for path, option in ((json_file, "--json"), (plot, "--plot")):
        options.check_file(path, option, () if truth is None else (truth,))
    if plot is None:
        return
    if plot.suffix.lower() not in _PLOT_FORMATS:
        raise UsageError(f"--plot {plot}: the name of a picture ends in {', '.join(_PLOT_FORMATS)}")
    if json_file is not None and json_file.resolve() == plot.resolve():
        raise UsageError(f"--plot {plot}: is also the file of --json; give another name")
    if any(plot.resolve().parent == folder.resolve() for folder in folders):
        raise UsageError(f"--plot {plot}: would count as a frame of the folder that it is in; choose another folder")


def _depths(
    features: FeatureSettings,
    references: ImageFolder,
    queries: ImageFolder,
    reference_depth: Path | None,
    query_depth: Path | None,
) -> tuple[ImageFolder | None, ImageFolder | None]:
    """List the depth folders, both or none, as the features need them."""
    named = (("--reference-depth", reference_depth, references), ("--query-depth", query_depth, queries))
    needed = "depth" in features.needs
    for option, path, _ in named:
        if needed and path is None:
            raise UsageError(f"{option}: missing; the modality depth needs --reference-depth and --query-depth")
        if not needed and path is not None:
            raise UsageError(f"{option} {path}: no modality uses depth; ask for it with --modalities, as in hog,depth")
    both = [_depth_folder(option, path, colour) for option, path, colour in named if path is not None]
    return (both[0], both[1]) if both else (None, None)


def _depth_folder(option: str, path: Path, colour: ImageFolder) -> ImageFolder:
    folder = list_folder(path, option)
    if len(folder.frames) != len(colour.frames):
        raise UsageError(
            f"{option} {path}: has {len(folder.frames)} images, and {colour.path} has {len(colour.frames)}; "
            "every image needs its depth"
        )
    return folder


def _say_skipped(traverses: Traverses, length: int) -> None:
    for folder, described, noun in (
        (traverses.references, traverses.reference_frames, "reference"),
        (traverses.queries, traverses.query_frames, "query"),
    ):
        say_skipped(folder, described)
        if described.numbers.size < length:
            frames = f"{described.numbers.size} {noun} frames are fewer than a window of {length} (--length)"
            sys.stderr.write(f"smal: {folder.path}: {frames}: nothing can be matched\n")


def _match(method: Method, traverses: Traverses, settings: MatchSettings) -> Matches:
    references, queries = traverses.reference_frames.features, traverses.query_frames.features
    with tqdm(total=len(queries), desc="matching", unit="frame", dynamic_ncols=True, disable=None) as bar:
        try:
            return method.match(references, queries, settings, lambda done: _advance(bar, done))
        except ValueError as error:
            raise JobError(f"cannot match these folders: {error}") from None
        except MemoryError:
            raise JobError(
                f"matching {len(queries)} and {len(references)} frames takes more memory than there is"
            ) from None


def _advance(bar: tqdm[NoReturn], done: int) -> None:
    bar.update(done - bar.n)


def _quality(matches: Matches, truth: IntervalTruth, length: int) -> Quality:
    judgement = judge(matches, truth)
    block = block_length(int(truth.judged.sum()), length)
    return Quality(PrecisionRecall.of(judgement), bootstrap_intervals(judgement, block))


def _draw(plot: Path, result: Result, truth: IntervalTruth | None) -> None:
    from services.commands.match_pictures import draw_matches  # noqa: PLC0415 - matplotlib takes a second to import

    folders = result.traverses
    figure = draw_matches(
        result.matches,
        len(folders.references.frames),
        truth,
        None if result.quality is None else result.quality.curve,
        f"{result.name}, l = {result.settings.length}, {described_by(result.settings.features)}",
    )
    with replacing(plot) as file:
        figure.savefig(file, dpi=150, format=plot.suffix[1:].lower())

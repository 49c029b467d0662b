"""``smal match``: which frame of one image folder shows the place of each frame of another."""

import time
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Final

import typer
from typer import Argument, Option

from services.cli import options, outputs
from services.cli.progress import Bars
from services.experiments.matching.image_folder import ImageFolder, Traverse, describe_frames, list_folder
from services.experiments.matching.report import Quality, Result, as_json, as_text, in_folders, title_of
from services.experiments.matching.truth_file import read_truth
from services.experiments.words import counted
from services.kit.errors import JobError, UsageError
from smal.evaluation.ground_truth import IntervalTruth
from smal.features import FeatureSettings
from smal.place_recognition import Matches
from smal.place_recognition.methods import METHODS, MatchSettings, Method

_PLOT_FORMATS: Final = (".png", ".svg", ".pdf")
_METHODS: Final = "; ".join(
    f"{name}: {method.meaning}" + (f" (l = {method.length})" if method.any_length else "")
    for name, method in METHODS.items()
)


def match(
    reference_dir: Annotated[Path, Argument(metavar="REFERENCE_DIR", help="Images of the traverse that is known.")],
    query_dir: Annotated[Path, Argument(metavar="QUERY_DIR", help="Images of the traverse to be recognized.")],
    name: Annotated[str, Option("--method", help=f"How places are recognized. {_METHODS}.")] = "smal",
    length: Annotated[int | None, Option(min=1, help="Frames of a window, l. [default: the method's]")] = None,
    modalities: options.Modalities = None,
    tolerance: Annotated[int | None, Option(min=0, max=10**6, help="Frames off that are right as well.")] = None,
    online: Annotated[int | None, Option(min=0, metavar="LAG", help="Answer each query so many frames later.")] = None,
    tau: Annotated[float | None, Option(min=-1e6, max=1e6, help="Leave out scores of at most this.")] = None,
    precision: Annotated[float | None, Option(min=0.0, max=1.0, help="Keep as many as are right so often.")] = None,
    reference_depth: Annotated[Path | None, Option(metavar="DIR", help="For the modality depth; see above.")] = None,
    query_depth: Annotated[Path | None, Option(metavar="DIR", help="The same for QUERY_DIR.")] = None,
    truth: Annotated[Path | None, Option(metavar="CSV", help="What is right; see above.")] = None,
    json_file: options.JsonFile = None,
    plot: Annotated[Path | None, Option(metavar="FILE", help="Draw the matches, as PNG, SVG or PDF.")] = None,
) -> None:
    """Find for every image of one folder the image of another that was taken at the same place.

    Frames are a folder's images in natural order (img2 before img10), counted from 0. Any format and size that OpenCV
    reads will do, grey or with 16 bits as well. An image that cannot be read is skipped and keeps its number.

    The score of smal is the probability that the match is right, to --tolerance frames (by default as far as references
    look alike, with --truth half of what usually is right). So --precision .99 keeps as many matches as are right in 99
    of 100 cases, and leaves out places that no reference shows. Scores of the other methods order the matches of one
    run, no more; their first queries have no match, as long as no window of --length frames ends there.

    What all images of a folder have in common, as its light, is taken away (but by paper and image), and smal looks at
    all queries before it answers: the more there are, the better it works. With --online LAG it answers a query by
    those up to LAG frames later: 0 as soon as it is seen.

    Depth images have 16 bits, in millimetres; --reference-depth has one for each of REFERENCE_DIR, in the same order.

    The file of --truth has the columns query, reference_first, reference_last, frames counted from 0, the last included
    (7,20,24): a row a query, or several where the references show its place several times. A query that no reference
    shows has the row 7,, and one without a row is not judged. It adds the area under the precision-recall curve (auc)
    and the recall at 100 % precision, both with 95 % intervals and of what is left; how far probabilities are off the
    share that is right (expected calibration error); and how often a known query is told from an unknown one.

    The JSON has all of this; the names of frames, read or not; and "matches", one for each query frame: {"query",
    "reference", "score", "unknown"}, reference null and score 0 where there is none, unknown the probability that no
    reference shows the query.

    Example: smal match summer winter --precision 0.99 --truth truth.csv --json matches.json --plot matches.png
    """
    probable = {"--tolerance": tolerance, "--online": online, "--precision": precision}
    method = _method_of(name, length, modalities, probable)
    settings = MatchSettings(modalities or method.features, length or method.length, tolerance, online)
    folders = [one for one in (reference_dir, query_dir, reference_depth, query_depth) if one is not None]
    _check_outputs(json_file, plot, [] if truth is None else [truth], folders)
    known, asked = list_folder(reference_dir, "REFERENCE_DIR"), list_folder(query_dir, "QUERY_DIR")
    named = (("--reference-depth", reference_depth, known), ("--query-depth", query_depth, asked))
    depths = [_depth_folder(settings.features, *one) for one in named]
    expected = None if truth is None else read_truth(truth, len(asked.frames), len(known.frames))
    if expected is not None and method.probable and tolerance is None:
        settings = replace(settings, tolerance=expected.tolerance)
    began_s = time.perf_counter()
    references = describe_frames(known, settings.features, depths[0], "reading references")
    queries = describe_frames(asked, settings.features, depths[1], "reading queries")
    read_s = time.perf_counter()
    for one in (references, queries):
        one.say_skipped()
        if one.numbers.size < settings.length:
            few = f"{counted(one.numbers.size, 'image')}, too few for a window of {settings.length}"
            raise JobError(f"{one.folder.path}: {few}; choose a shorter --length")
    found = in_folders(_match(method, references, queries, settings), references, queries)
    matches = found if tau is None else found.above(tau)
    matches = matches if precision is None else matches.surest(precision)
    seconds = {"reading": read_s - began_s, "matching": time.perf_counter() - read_s}
    quality = Quality.of(matches, expected, settings.length, probable=method.probable) if expected else None
    unsure = int(found.matched.sum() - matches.matched.sum())
    chosen: dict[str, object] = {"method": name, "length": settings.length if method.any_length else None}
    chosen |= {"tolerance": settings.tolerance, "online": online, "tau": tau, "precision": precision}
    result = Result(chosen, settings, references, queries, matches, unsure, quality, seconds)
    written: list[Path] = []
    try:
        if json_file is not None:
            outputs.write_json(json_file, "--json", as_json(result))
            written.append(json_file)
        if plot is not None:
            _draw(plot, result, expected)
            written.append(plot)
    finally:
        # Also where a file cannot be written: the figures have cost their time.
        for line in as_text(result, written):
            typer.echo(line)


def _method_of(
    name: str, length: int | None, modalities: FeatureSettings | None, probable: dict[str, float | None]
) -> Method:
    """Take a method of the table; options that only those with probabilities know are given by their names."""
    if name not in METHODS:
        raise UsageError(f"--method {name}: unknown; known are {', '.join(METHODS)}")
    method = METHODS[name]
    if not method.any_features and modalities:
        own = ", ".join(method.features.modalities)
        raise UsageError(f"--modalities {modalities.text}: the method {name} has its own features, {own}")
    if length not in (None, method.length) and not method.any_length:
        raise UsageError(f"--length {length}: the method {name} has no windows")
    for option, value in probable.items():
        if value is not None and not method.probable:
            raise UsageError(f"{option} {value}: the scores of the method {name} are no probabilities")
    return method


def _check_outputs(json_file: Path | None, plot: Path | None, read: list[Path], folders: list[Path]) -> None:
    for path, option in ((json_file, "--json"), (plot, "--plot")):
        outputs.check_file(path, option, read, folders)
    if plot is None:
        return
    if plot.suffix.lower() not in _PLOT_FORMATS:
        raise UsageError(f"--plot {plot}: the name of a picture ends in {', '.join(_PLOT_FORMATS)}")
    if json_file is not None and json_file.resolve() == plot.resolve():
        raise UsageError(f"--plot {plot}: is also the file of --json; give another name")


def _depth_folder(features: FeatureSettings, option: str, path: Path | None, colour: ImageFolder) -> ImageFolder | None:
    if path is None or "depth" not in features.needs:
        if path is not None or "depth" in features.needs:
            raise UsageError(f"{option}: belongs to the modality depth (--modalities hog,depth), which needs it")
        return None
    folder = list_folder(path, option)
    if (count := len(folder.frames)) != len(colour.frames):
        raise UsageError(f"{option} {path}: has {count} images, and {colour.path} has {len(colour.frames)}")
    return folder


def _match(method: Method, references: Traverse, queries: Traverse, settings: MatchSettings) -> Matches:
    sizes = len(queries.features), len(references.features)
    with closing(Bars("frame")) as bars:
        try:
            return method.match(
                references.features, queries.features, settings, lambda done: bars("matching", done, sizes[0])
            )
        except ValueError as error:
            raise JobError(f"cannot match these folders: {error}") from None
        except MemoryError:
            raise JobError("matching {} and {} frames takes more memory than there is".format(*sizes)) from None


def _draw(plot: Path, result: Result, truth: IntervalTruth | None) -> None:
    from services.experiments.matching.pictures import draw_matches  # noqa: PLC0415 - matplotlib takes a second to import

    count = len(result.references.folder.frames)
    figure = draw_matches(result.matches, count, truth, result.quality, title_of(result))
    with outputs.writing(plot, "--plot") as file:
        figure.savefig(file, dpi=150, format=plot.suffix[1:].lower())

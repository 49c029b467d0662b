"""``smal match``: which frame of one traverse shows the place of each frame of another, or one before it."""

import time
from contextlib import closing
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated, Final

import typer
from typer import Argument, Option

from services.cli import options, outputs
from services.experiments.matching import truth_file
from services.experiments.matching.page import judging_page
from services.experiments.matching.report import (
    MatchQuality,
    Result,
    as_g2o,
    as_json,
    as_text,
    in_sources,
    title_of,
)
from services.experiments.matching.sources import TraverseSource, open_source
from services.experiments.matching.traverse import Traverse, describe_frames
from services.experiments.progress import Bars
from services.experiments.words import counted
from services.kit.errors import JobError, UsageError
from smal.evaluation.ground_truth import IntervalTruth
from smal.features import FeatureSettings
from smal.place_recognition import Matches
from smal.place_recognition.methods import METHODS, MatchSettings, Method

_PLOT_FORMATS: Final = (".png", ".svg", ".pdf")
_LOOP_PRECISION: Final = (
    0.99  # Loops are kept that are right so often: a wrong one bends a whole map.
)
_METHODS: Final = "; ".join(
    f"{name}: {method.meaning}" + (f" (l = {method.length})" if method.any_length else "")
    for name, method in METHODS.items()
)


def match(
    reference: Annotated[
        Path, Argument(metavar="REFERENCES", help="The traverse that is known; see above.")
    ],
    query: Annotated[
        Path | None, Argument(metavar="QUERIES", help="The traverse to be recognized.")
    ] = None,
    name: Annotated[
        str, Option("--method", help=f"How places are recognized. {_METHODS}.")
    ] = "smal",
    length: Annotated[
        int | None, Option(min=1, help="Frames of a window, l. [default: the method's]")
    ] = None,
    modalities: options.Modalities = None,
    tolerance: Annotated[
        int | None, Option(min=0, max=10**6, help="Frames off that are right as well.")
    ] = None,
    online: Annotated[
        int | None, Option(min=0, metavar="LAG", help="Answer each query so many frames later.")
    ] = None,
    tau: Annotated[
        float | None, Option(min=-1e6, max=1e6, help="Leave out scores of at most this.")
    ] = None,
    precision: Annotated[
        float | None, Option(min=0.0, max=1.0, help="Keep as many as are right so often.")
    ] = None,
    reference_depth: Annotated[
        Path | None, Option(metavar="DIR", help="For the modality depth; see above.")
    ] = None,
    query_depth: Annotated[Path | None, Option(metavar="DIR", help="The same for QUERIES.")] = None,
    truth: Annotated[
        str | None, Option(metavar="CSV|names|gps", help="What is right; see above.")
    ] = None,
    poses: Annotated[
        tuple[Path, Path] | None, Option(metavar="REFERENCES QUERIES", help="Two CSV files.")
    ] = None,
    radius: Annotated[
        float | None, Option(min=0.0, metavar="M", help="Nearer frames show the same place.")
    ] = None,
    loops: Annotated[
        Path | None, Option(metavar="FILE", help="Match REFERENCES with itself, as edges of g2o.")
    ] = None,
    at_work: options.AtWork = options.HERE,
    json_file: options.JsonFile = None,
    plot: Annotated[
        Path | None, Option(metavar="FILE", help="Draw the matches, as PNG, SVG or PDF.")
    ] = None,
    page: Annotated[
        Path | None, Option(metavar="FILE", help="A page to judge matches on; see above.")
    ] = None,
) -> None:
    """Find for every image of one traverse the image of another that was taken at the same place.

    A traverse is a folder of images in natural order (img2 before img10), a video, or a recording of SMAL (.mcap); its
    frames count from 0. Any format and size that OpenCV reads will do, grey or with 16 bits as well. An image that
    cannot be read is skipped and keeps its number. Features are kept in $XDG_CACHE_HOME/smal (~/.cache/smal, of at
    most 90,000 images), so that the next run with the same ones takes seconds.

    The score of smal is the probability that the match is right, to --tolerance frames (by default as far as references
    look alike, with --truth half of what usually is right). So --precision .99 keeps as many matches as are right in 99
    of 100 cases, and leaves out places that no reference shows. Scores of the other methods order the matches of one
    run, no more; their first queries have no match, as long as no window of --length frames ends there.

    What all images of a traverse have in common, as its light, is taken away (but by paper and image), and smal looks
    at all queries before it answers: the more there are, the better it works. With --online LAG it answers a query by
    those up to LAG frames later: 0 as soon as it is seen.

    --loops FILE needs no QUERIES: each frame is matched with those long before it, at --precision .99. FILE gets an
    edge of g2o for each: EDGE_SE2 EARLIER LATER 0 0 0, information the score for x and y, 0 for the heading.

    Depth images have 16 bits, in millimetres; --reference-depth has one for each of REFERENCES, in the same order.

    The file of --truth has the columns query, reference_first, reference_last, frames counted from 0, the last included
    (7,20,24): a row a query, or several where the references show its place several times. A query that no reference
    shows has the row 7,, and one without a row is not judged. --truth names takes images of one name for one place (to
    --tolerance frames), --truth gps those within --radius metres by EXIF, and --poses by two files with the columns
    frame, x_m, y_m. It adds the area under the precision-recall curve (auc) and the recall at 100 % precision, both
    with 95 % intervals and of what is left; how far probabilities are off the share that is right (expected calibration
    error); and how often a known query is told from an unknown one.

    --page FILE shows the 200 most doubtful matches as images; say there which are right, and save a file for --truth.

    The JSON has all of this; the names of frames, read or not; and "matches", one for each query frame: {"query",
    "reference", "score", "unknown"}, reference null and score 0 where there is none, unknown the probability that no
    reference shows the query.

    Example: smal match summer winter --precision 0.99 --truth truth.csv --json matches.json --plot matches.png;
    smal match summer.mp4 winter.mp4 --page judge.html; smal match summer winter --truth gps --radius 5;
    smal match summer winter --poses summer.csv winter.csv --radius 5; smal match drive --loops loops.g2o
    """
    probable = {
        "--tolerance": tolerance,
        "--online": online,
        "--precision": precision,
        "--loops": loops,
    }
    method = _method_of(name, length, modalities, probable)
    settings = MatchSettings(
        modalities or method.features, length or method.length, tolerance, online
    )
    settings = replace(settings, loops=loops is not None)
    precision = _LOOP_PRECISION if loops is not None and precision is None else precision
    if (query is None) != settings.loops:
        missing = "QUERIES: missing; --loops FILE does without"
        raise UsageError(missing if query is None else "--loops: takes no QUERIES")
    read = [one for one in (reference, query, reference_depth, query_depth) if one is not None]
    told = [Path(truth)] if truth else [*(poses or ())]
    files = {"--json": json_file, "--loops": loops, "--page": page, "--plot": plot}
    _check_outputs(files, [*told, *read], read)
    known = open_source(reference, "REFERENCES")
    asked = known if query is None else open_source(query, "QUERIES")
    query_depth = reference_depth if settings.loops else query_depth
    named = (("--reference-depth", reference_depth, known), ("--query-depth", query_depth, asked))
    depths = [_depth_folder(settings.features, *one) for one in named]
    expected = _truth(truth, poses, radius, tolerance or 0, known, asked)
    if expected is not None and method.probable and tolerance is None:
        settings = replace(settings, tolerance=expected.tolerance)
    began_s = time.perf_counter()
    with at_work.engine() as engine:
        references = queries = describe_frames(
            known, settings.features, depths[0], "reading references", engine
        )
        if query is not None:
            queries = describe_frames(
                asked, settings.features, depths[1], "reading queries", engine
            )
        read_s = time.perf_counter()
        for one in (references, queries)[: 1 if settings.loops else 2]:
            one.say_skipped()
            if one.numbers.size < settings.length:
                few = f"{counted(one.numbers.size, 'image')}, too few for a window of {settings.length}"
                raise JobError(f"{one.source.path}: {few}; choose a shorter --length")
        matched = _match(method, references, queries, replace(settings, parallel=engine.map))
    found = in_sources(matched, references, queries)
    matches = found if tau is None else found.above(tau)
    matches = matches if precision is None else matches.surest(precision)
    seconds = {"reading": read_s - began_s, "matching": time.perf_counter() - read_s}
    quality = (
        MatchQuality.of(matches, expected, settings.length, probable=method.probable)
        if expected
        else None
    )
    unsure = int(found.matched.sum() - matches.matched.sum())
    chosen: dict[str, object] = {
        "method": name,
        "length": settings.length if method.any_length else None,
    }
    chosen |= {
        "tolerance": settings.tolerance,
        "online": online,
        "tau": tau,
        "precision": precision,
    }
    result = Result(
        chosen, settings, references, queries, matches, unsure, quality, seconds, method.probable
    )
    written: list[Path] = []
    try:
        for option, path in files.items():
            if path is not None:
                _write(option, path, result, expected)
                written.append(path)
    finally:
        # Also where a file cannot be written: the figures have cost their time.
        for line in as_text(result, written):
            typer.echo(line)


def _truth(
    truth: str | None,
    poses: tuple[Path, Path] | None,
    radius: float | None,
    tolerance: int,
    known: TraverseSource,
    asked: TraverseSource,
) -> IntervalTruth | None:
    if (by_radius := truth == "gps" or poses is not None) != (radius is not None):
        raise UsageError(
            "--radius: is missing"
            if by_radius
            else "--radius: belongs to --truth gps and to --poses"
        )
    if truth is not None and poses is not None:
        raise UsageError("--poses: --truth says already what is right; give one of them")
    if known is asked and (by_radius or truth == "names"):
        raise UsageError("--loops: every frame is near itself and named so; --truth takes a file")
    if radius is not None and poses is not None:
        here = truth_file.read_positions(poses[0], len(known.frames))
        there = truth_file.read_positions(poses[1], len(asked.frames))
        return truth_file.truth_by_positions(here, there, radius, f"--poses, within {radius:g} m")
    if radius is not None:
        return truth_file.truth_by_positions(
            *truth_file.gps_positions(known, asked), radius, f"--truth gps, within {radius:g} m"
        )
    if truth == "names":
        return truth_file.truth_by_names(known.frames, asked.frames, tolerance)
    return (
        None
        if truth is None
        else truth_file.read_truth(Path(truth), len(asked.frames), len(known.frames))
    )


def _method_of(
    name: str,
    length: int | None,
    modalities: FeatureSettings | None,
    probable: dict[str, float | Path | None],
) -> Method:
    """Take a method of the table; options that only those with probabilities know are given by their names."""
    if name not in METHODS:
        raise UsageError(f"--method {name}: unknown; known are {', '.join(METHODS)}")
    method = METHODS[name]
    if not method.any_features and modalities:
        own = ", ".join(method.features.modalities)
        raise UsageError(
            f"--modalities {modalities.text}: the method {name} has its own features, {own}"
        )
    if length not in (None, method.length) and not method.any_length:
        raise UsageError(f"--length {length}: the method {name} has no windows")
    for option, value in probable.items():
        if value is not None and not method.probable:
            raise UsageError(
                f"{option} {value}: the scores of the method {name} are no probabilities"
            )
    return method


def _check_outputs(files: dict[str, Path | None], read: list[Path], folders: list[Path]) -> None:
    given = {option: path for option, path in files.items() if path is not None}
    for option, path in given.items():
        outputs.check_file(path, option, read, folders)
        same = [
            other
            for other, one in given.items()
            if other < option and one.resolve() == path.resolve()
        ]
        if same:
            raise UsageError(f"{option} {path}: is also the file of {same[0]}; give another name")
    if (plot := files["--plot"]) is not None and plot.suffix.lower() not in _PLOT_FORMATS:
        raise UsageError(f"--plot {plot}: the name of a picture ends in {', '.join(_PLOT_FORMATS)}")


def _depth_folder(
    features: FeatureSettings, option: str, path: Path | None, colour: TraverseSource
) -> TraverseSource | None:
    if path is None or "depth" not in features.needs:
        if path is not None or "depth" in features.needs:
            raise UsageError(
                f"{option}: belongs to the modality depth (--modalities hog,depth), which needs it"
            )
        return None
    folder = open_source(path, option)
    if (count := len(folder.frames)) != len(colour.frames):
        raise UsageError(
            f"{option} {path}: has {count} images, and {colour.path} has {len(colour.frames)}"
        )
    return folder


def _match(
    method: Method, references: Traverse, queries: Traverse, settings: MatchSettings
) -> Matches:
    sizes = len(queries.features), len(references.features)
    with closing(Bars("frame")) as bars:
        try:
            advance = partial(bars, "matching", total=sizes[0])
            return method.match(references.features, queries.features, settings, advance)
        except ValueError as error:
            raise JobError(f"cannot match these traverses: {error}") from None
        except MemoryError:
            raise JobError(
                "matching {} and {} frames takes more memory than there is".format(*sizes)
            ) from None


def _write(option: str, path: Path, result: Result, truth: IntervalTruth | None) -> None:
    texts = {"--json": as_json, "--loops": as_g2o, "--page": judging_page}
    if option != "--plot":
        with outputs.writing(path, option) as file:
            file.write(texts[option](result).encode())
        return
    from services.experiments.matching.pictures import draw_matches  # noqa: PLC0415 - matplotlib takes a second to import

    count = len(result.references.source.frames)
    figure = draw_matches(result.matches, count, truth, result.quality, title_of(result))
    with outputs.writing(path, option) as file:
        figure.savefig(file, dpi=150, format=path.suffix[1:].lower())

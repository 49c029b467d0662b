"""``smal match``: find the images of one traverse that show the places of another."""

import time
from contextlib import closing
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final, NamedTuple

import typer
from typer import Argument, Option

from services.cli import options, outputs
from services.experiments.engine import Engine
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

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_PLOT_FORMATS: Final = (".png", ".svg", ".pdf")
_LOOP_PRECISION: Final = 0.99  # For loop closure: a wrong loop distorts a whole map.
_METHODS: Final = "; ".join(
    f"{name}: {method.meaning}" + (f" (l = {method.length})" if method.any_length else "")
    for name, method in METHODS.items()
)
_TEXTS: Final = {"--json": as_json, "--loops": as_g2o, "--page": judging_page}


@dataclass(frozen=True)
class MatchMethod:
    """Method of place recognition and its parameters."""

    method: Annotated[str, Option(help=f"Method of place recognition. {_METHODS}.")] = "smal"
    length: Annotated[
        int | None, Option(min=1, help="Window length l, frames. [default: the method's]")
    ] = None
    modalities: options.Modalities = None
    tolerance: Annotated[
        int | None, Option(min=0, max=10**6, help="Largest error of a correct match, frames.")
    ] = None
    online: Annotated[
        int | None, Option(min=0, metavar="LAG", help="Latency of each answer, frames.")
    ] = None
    tau: Annotated[
        float | None, Option(min=-1e6, max=1e6, help="Score above which matches are kept.")
    ] = None
    precision: Annotated[
        float | None,
        Option(min=0.0, max=1.0, help="Share of correct matches among the kept matches."),
    ] = None

    def chosen(self) -> Method:
        """Return the method; raise UsageError if it does not support one of the options."""
        if self.method not in METHODS:
            raise UsageError(f"--method {self.method}: not found; choose from {', '.join(METHODS)}")
        method = METHODS[self.method]
        if not method.any_features and self.modalities:
            own = ", ".join(method.features.modalities)
            raise UsageError(
                f"--modalities {self.modalities.text}: unsupported: the method {self.method} "
                f"uses {own}"
            )
        if self.length not in (None, method.length) and not method.any_length:
            raise UsageError(
                f"--length {self.length}: unsupported: the method {self.method} uses no windows"
            )
        for name in ("tolerance", "online", "precision"):
            if (value := getattr(self, name)) is not None:
                self.require_probable(method, f"--{name} {value}")
        return method

    def require_probable(self, method: Method, option: str) -> None:
        """Raise UsageError with the name of an option unless scores are probabilities."""
        if not method.probable:
            raise UsageError(
                f"{option}: unsupported: scores of the method {self.method} are not probabilities"
            )

    def select(self, found: Matches) -> Matches:
        """Return the matches with scores above --tau that reach --precision."""
        found = found if self.tau is None else found.above(self.tau)
        return found if self.precision is None else found.surest(self.precision)


@dataclass(frozen=True)
class Depth:
    """Folders of depth images."""

    reference_depth: Annotated[
        Path | None, Option(metavar="DIR", help="Depth images of REFERENCES; see above.")
    ] = None
    query_depth: Annotated[Path | None, Option(metavar="DIR", help="Depth images of QUERIES.")] = (
        None
    )


@dataclass(frozen=True)
class Truth:
    """Source of the ground truth."""

    truth: Annotated[
        str | None, Option(metavar="CSV|names|gps", help="Ground truth; see above.")
    ] = None
    poses: Annotated[
        tuple[Path, Path] | None,
        Option(metavar="REFERENCES QUERIES", help="Positions of the frames, two CSV files."),
    ] = None
    radius: Annotated[
        float | None,
        Option(
            min=0.0, metavar="M", help="Distance within which two positions are the same place."
        ),
    ] = None

    @property
    def files(self) -> list[Path]:
        """The input files."""
        return [Path(self.truth)] if self.truth else [*(self.poses or ())]

    def read(
        self, known: TraverseSource, asked: TraverseSource, tolerance: int
    ) -> IntervalTruth | None:
        """Return the ground truth of two traverses, or of one traverse and itself, if given."""
        self._check(loops=known is asked)
        within = f"within {self.radius or 0.0:g} m"
        if self.poses is not None:
            here = truth_file.read_positions(self.poses[0], len(known.frames))
            there = truth_file.read_positions(self.poses[1], len(asked.frames))
            named = f"--poses, {within}"
            return truth_file.truth_by_positions(here, there, self.radius or 0.0, named)
        match self.truth:
            case None:
                return None
            case "gps":
                here, there = truth_file.gps_positions(known, asked)
                named = f"--truth gps, {within}"
                return truth_file.truth_by_positions(here, there, self.radius or 0.0, named)
            case "names":
                return truth_file.truth_by_names(known.frames, asked.frames, tolerance)
            case path:
                return truth_file.read_truth(Path(path), len(asked.frames), len(known.frames))

    def _check(self, *, loops: bool) -> None:
        by_radius = self.truth == "gps" or self.poses is not None
        if by_radius and self.radius is None:
            raise UsageError("--radius: missing")
        if self.radius is not None and not by_radius:
            raise UsageError("--radius: requires --truth gps or --poses")
        if self.truth is not None and self.poses is not None:
            raise UsageError("--poses: conflicts with --truth; give only one")
        if loops and (by_radius or self.truth == "names"):
            raise UsageError(
                "--loops: conflicts with ground truth by positions or names; give --truth a file"
            )


@dataclass(frozen=True)
class MatchFiles:
    """Files of the results."""

    json_file: options.JsonFile = None
    loops: Annotated[
        Path | None, Option(metavar="FILE", help="Loop closures of REFERENCES as edges of g2o.")
    ] = None
    page: Annotated[
        Path | None, Option(metavar="FILE", help="Page to judge matches on; see above.")
    ] = None
    plot: Annotated[
        Path | None, Option(metavar="FILE", help="Drawing of the matches, PNG, SVG or PDF.")
    ] = None

    @property
    def given(self) -> dict[str, Path]:
        """The files by option."""
        names = {"json_file": "--json"}
        found = {
            names.get(one.name, f"--{one.name}"): getattr(self, one.name) for one in fields(self)
        }
        return {option: path for option, path in found.items() if path is not None}

    def check(self, read: list[Path], folders: list[Path]) -> None:
        """Check that every file can be written and differs from all others and from all input."""
        options_of: dict[Path, str] = {}
        for option, path in self.given.items():
            outputs.check_file(path, option, read, folders)
            other = options_of.setdefault(path.resolve(), option)
            if other != option:
                raise UsageError(f"{option} {path}: same file as {other}; choose another name")
        if self.plot is not None and self.plot.suffix.lower() not in _PLOT_FORMATS:
            raise UsageError(
                f"--plot {self.plot}: unsupported; the file name must end in "
                f"{', '.join(_PLOT_FORMATS)}"
            )


class _Sources(NamedTuple):
    """The two traverses (for loops the same one) and their depth images."""

    known: TraverseSource
    asked: TraverseSource
    depths: list[TraverseSource | None]

    @classmethod
    def open(
        cls, reference: Path, query: Path | None, depth: Depth, features: FeatureSettings
    ) -> "_Sources":
        known = open_source(reference, "REFERENCES")
        asked = known if query is None else open_source(query, "QUERIES")
        query_depth = depth.reference_depth if query is None else depth.query_depth
        named = (
            ("--reference-depth", depth.reference_depth, known),
            ("--query-depth", query_depth, asked),
        )
        return cls(known, asked, [_depth_folder(features, *one) for one in named])

    def describe(self, settings: MatchSettings, engine: Engine) -> tuple[Traverse, Traverse]:
        """Compute the features of both traverses; raise JobError if one is shorter than a window."""
        titles = ("reading references", "reading queries")
        sources = (self.known,) if settings.loops else (self.known, self.asked)
        found = [
            describe_frames(source, settings.features, depth, title, engine)
            for source, depth, title in zip(sources, self.depths, titles, strict=False)
        ]
        for one in found:
            one.say_skipped()
            if one.numbers.size < settings.length:
                few = (
                    f"{counted(one.numbers.size, 'image')}, too few for a window of "
                    f"{settings.length}"
                )
                raise JobError(f"{one.source.path}: {few}; choose a shorter --length")
        return found[0], found[-1]


def match(
    *,
    reference: Annotated[Path, Argument(metavar="REFERENCES", help="Known traverse; see above.")],
    query: Annotated[Path | None, Argument(metavar="QUERIES", help="Traverse to match.")] = None,
    way: MatchMethod,
    depth: Depth,
    truth: Truth,
    at_work: options.AtWork = options.HERE,
    files: MatchFiles,
) -> None:
    """Match the images of two traverses that were taken at the same place.

    Input: a traverse is a folder of images in natural order (img2 before img10), a video, or a
    recording of SMAL (.mcap); its frames count from 0. All image formats, sizes and bit depths of
    OpenCV are supported, and turned upright by their EXIF orientation. Unreadable images are
    skipped and keep their number. Features are cached in $XDG_CACHE_HOME/smal (~/.cache/smal,
    maximum 90,000 images).

    Scores: the score of smal is the probability that the match is correct within --tolerance
    frames. The default tolerance is the distance over which references look alike; with --truth,
    half of the usual interval. --precision .99 keeps the most confident matches of which 99 of 100
    are correct, and omits places that no reference shows. Scores of other methods only rank the
    matches of one run; their first queries have no match until a window of --length frames is
    complete.

    Except for paper and image, the average image of a traverse (such as its light) is removed. smal
    uses all queries for each answer. With --online LAG it answers with a latency of LAG frames (0:
    immediately).

    Loops: --loops FILE matches each frame with much earlier frames, without QUERIES, at --precision
    .99. FILE has an edge of g2o for each: EDGE_SE2 EARLIER LATER 0 0 0, with the score as
    information for x and y, and 0 for the heading.

    Depth: images have 16 bits, in millimetres; --reference-depth has one image for each of
    REFERENCES, in the same order.

    Ground truth: the file of --truth has the columns query, reference_first, reference_last, with
    frames counted from 0 and the last frame included (7,20,24). A query has several rows if
    references show its place several times. The row 7,, marks a query that no reference shows.
    Queries without a row are not evaluated. --truth names matches equal file names (within
    --tolerance frames), --truth gps EXIF positions within --radius metres, and --poses two files
    with the columns frame, x_m, y_m. The report adds the area under the precision-recall curve
    (auc) and the recall at 100 % precision, both with 95 % intervals and after filtering, the
    expected calibration error, and how well unknown queries are detected.

    Judging: --page FILE shows the 200 least certain matches as images. Mark the correct matches
    there and save a file for --truth.

    JSON: all results, the names of frames, and "matches", one for each query frame: {"query",
    "reference", "score", "unknown"}. Without a match, reference is null and score 0. unknown is the
    probability that no reference shows the query.

    Example: smal match summer winter --precision 0.99 --truth truth.csv --json matches.json --plot
    matches.png;
    smal match summer.mp4 winter.mp4 --page judge.html; smal match summer winter --truth gps
    --radius 5;
    smal match summer winter --poses summer.csv winter.csv --radius 5; smal match drive --loops
    loops.g2o
    """
    method = way.chosen()
    loops = files.loops is not None
    if loops:
        way.require_probable(method, f"--loops {files.loops}")
        way = replace(way, precision=_LOOP_PRECISION if way.precision is None else way.precision)
    if (query is None) != loops:
        missing = "QUERIES: missing; only --loops FILE works without them"
        raise UsageError(missing if query is None else "--loops: unsupported with QUERIES")
    given = (reference, query, depth.reference_depth, depth.query_depth)
    read = [path for path in given if path is not None]
    files.check([*truth.files, *read], read)
    features = way.modalities or method.features
    settings = MatchSettings(
        features, way.length or method.length, way.tolerance, way.online, loops
    )
    sources = _Sources.open(reference, query, depth, features)
    expected = truth.read(sources.known, sources.asked, way.tolerance or 0)
    if expected is not None and method.probable and way.tolerance is None:
        settings = replace(settings, tolerance=expected.tolerance)
    began_s = time.perf_counter()
    with at_work.engine() as engine:
        references, queries = sources.describe(settings, engine)
        read_s = time.perf_counter()
        matched = _match(method, references, queries, replace(settings, parallel=engine.map))
    seconds = {"reading": read_s - began_s, "matching": time.perf_counter() - read_s}
    found = in_sources(matched, references, queries)
    matches = way.select(found)
    result = Result(
        chosen={
            "method": way.method,
            "length": settings.length if method.any_length else None,
            "tolerance": settings.tolerance,
            "online": way.online,
            "tau": way.tau,
            "precision": way.precision,
        },
        settings=settings,
        references=references,
        queries=queries,
        matches=matches,
        unsure=int(found.matched.sum() - matches.matched.sum()),
        quality=None
        if expected is None
        else MatchQuality.of(matches, expected, settings.length, probable=method.probable),
        seconds=seconds,
        probable=method.probable,
    )
    _write(files, result, expected)


def _depth_folder(
    features: FeatureSettings, option: str, path: Path | None, colour: TraverseSource
) -> TraverseSource | None:
    if path is None or "depth" not in features.needs:
        if path is not None or "depth" in features.needs:
            raise UsageError(
                f"{option}: requires the modality depth, and vice versa (--modalities hog,depth)"
            )
        return None
    folder = open_source(path, option)
    if (count := len(folder.frames)) != len(colour.frames):
        raise UsageError(
            f"{option} {path}: {count} images, but {colour.path} has {len(colour.frames)}"
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
            raise JobError("out of memory while matching {} and {} frames".format(*sizes)) from None


def _write(files: MatchFiles, result: Result, truth: IntervalTruth | None) -> None:
    written: list[Path] = []
    try:
        for option, path in files.given.items():
            with outputs.writing(path, option) as file:
                if option == "--plot":
                    kind = path.suffix[1:].lower()
                    _drawn(result, truth).savefig(file, dpi=150, format=kind)
                else:
                    file.write(_TEXTS[option](result).encode())
            written.append(path)
    finally:
        # Print the figures even if a file cannot be written, because they took time to compute.
        typer.echo("\n".join(as_text(result, written)))


def _drawn(result: Result, truth: IntervalTruth | None) -> "Figure":
    from services.experiments.matching.pictures import draw_matches  # noqa: PLC0415 - matplotlib takes a second to import

    count = len(result.references.source.frames)
    return draw_matches(result.matches, count, truth, result.quality, title_of(result))

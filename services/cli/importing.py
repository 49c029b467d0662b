"""``smal import``: recordings that somebody has already, to teach from."""

import json
from collections.abc import Iterator
from contextlib import closing
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Final

import typer
from typer import Argument, Option

from schemas.base import STILL, TURNING
from schemas.codec import printable
from services.cli import options, outputs
from services.experiments.progress import Bars
from services.experiments.words import remark
from services.importers.job import FORMATS, ImportJob, ImportReport, check_format
from services.importers.run import MOST_MEMORY
from services.importers.ticks import QUANTILE
from services.kit.errors import JobError, UsageError
from services.recordings.sink import free_path, publish
from smal.files.confined import ConfinedError, WorkLimits, confined, size_of

_WORK: Final = "services.importers.run:work"


@dataclass(frozen=True)
class Part:
    """Which part of a source is imported, and what it shows; the fields are those of `ImportJob`."""

    goal: options.GoalOfDrives = "victim"
    success: Annotated[
        bool | None, Option("--succeeded/--failed", help="Whether the drives reached the goal.")
    ] = None
    camera: Annotated[
        str | None, Option(help="Topic of a bag, or feature of LeRobot, with the images.")
    ] = None
    velocity: Annotated[str | None, Option(help="Source of the velocities; see above.")] = None
    episodes: Annotated[
        list[str] | None,
        Option("--episode", help="Only this drive, by the source's name; may be repeated."),
    ] = None
    from_s: Annotated[
        float, Option("--from", min=0, metavar="S", help="Omitted first seconds of each drive.")
    ] = 0.0
    to_s: Annotated[
        float, Option("--to", min=0, metavar="S", help="End of each drive.", show_default=False)
    ] = 1e9
    robot: options.Robot = options.DEFAULT_ROBOT


@dataclass(frozen=True)
class SourceScale:
    """What the values of a source mean; the fields are those of `ImportJob`."""

    rate_hz: Annotated[
        float | None,
        Option("--rate", min=0.1, max=1000, metavar="HZ", help="Frames a second; see above."),
    ] = None
    speed: Annotated[
        float | None, Option(metavar="M_S", help="Metres a second of a speed of 1.")
    ] = None
    turn_rate: Annotated[
        float | None, Option(metavar="RAD_S", help="Radians a second of a turn rate of 1.")
    ] = None
    quantile: Annotated[
        float, Option(help="Share of moving samples that nominal speed exceeds.")
    ] = QUANTILE
    still: Annotated[float, Option(help="Fraction of nominal below which the robot stands.")] = (
        STILL
    )
    turning: Annotated[
        float, Option(help="Fraction of the nominal turn rate from which on the robot turns.")
    ] = TURNING
    field_of_view_deg: Annotated[
        float | None,
        Option(
            "--field-of-view",
            min=5,
            max=170,
            metavar="DEG",
            help="Horizontal field of view of the camera. [default: the source's]",
        ),
    ] = None
    no_odometry: Annotated[bool, Option("--no-odometry", help="No odometry from velocities.")] = (
        False
    )


def import_recordings(
    *,
    format_: Annotated[str, Argument(metavar="FORMAT", help=f"One of {', '.join(FORMATS)}.")],
    path: Annotated[
        Path, Argument(metavar="PATH", help="The source: a folder, or of a bag the file.")
    ],
    out: Annotated[Path, Option(help="Folder for the recordings, one MCAP file a drive.")] = Path(
        "recordings"
    ),
    part: Part,
    scale: SourceScale,
    json_file: options.JsonFile = None,
) -> None:
    """Make recordings that `smal learn` takes out of what somebody recorded with other software.

    rosbag2: a bag of ROS 2 (MCAP or SQLite) with images and Twist, TwistStamped or Odometry; a bag is one drive, and
    several go into one OUT, each by an import of its own. lerobot: a LeRobotDataset (v2.0, v2.1, v3.0) of a base.
    donkeycar: a tub of version 2. folder: images and a drive.csv with the columns image, time_s, linear_m_s,
    angular_rad_s (and episode, success, x_m, y_m, heading_rad).

    Unless the source or --failed says otherwise, drives reached the goal. --velocity is a bag's topic, or
    LINEAR,ANGULAR of a LeRobot action. A speed of 1 is 1 m/s (of donkeycar unknown), a turn rate of 1 is 1 rad/s (of
    x.vel and theta.vel a degree a second). --rate is for a source whose times are wrong.

    Whatever rate the source has, a recording has 10 frames a second. Velocities become the atoms forward, backward,
    left, right and stop by --still and --turning, fractions of the robot's own nominal speed and turn rate.
    What does not fit is named, with its count. JPEG images stay as they are. No file outside of PATH is read.

    Example: smal import donkeycar tub --rate 20 --to 25 --out drives
    """
    form = check_format(format_)
    outputs.check_file(json_file, "--json")
    if part.to_s <= part.from_s:
        raise UsageError(f"--to {part.to_s:g}: is not after --from {part.from_s:g}")
    with outputs.workshop(out, "--out") as folder:
        asked = asdict(part) | asdict(scale) | {"episodes": tuple(part.episodes or ())}
        asked["reckon"] = not asked.pop("no_odometry")
        job = ImportJob(format=form, path=str(path), folder=str(folder), **asked)
        remarks, report = _run(job)
        files = []
        for made in map(Path, report.files):
            files.append(free_path(out, made.stem))
            publish(made, files[-1])
    remark(remarks)
    if json_file is not None:
        content = report.model_dump(mode="json") | {
            "files": [str(file) for file in files],
            "remarks": remarks,
        }
        outputs.write_json(json_file, "--json", content)
    typer.echo("\n".join(_lines(report, job, files, out)))


def _run(job: ImportJob) -> tuple[list[str], ImportReport]:
    """Do the job in a process of its own; see `services.importers.run`."""
    limits = WorkLimits.of_size(size_of(Path(job.path)), MOST_MEMORY)
    with closing(Bars("frame")) as bars:

        def show(progress: dict[str, int]) -> None:
            bars("importing", progress["done"], progress["total"])

        try:
            done = confined(_WORK, job.model_dump(mode="json"), limits, job.path, progress=show)
        except ConfinedError as error:
            raise JobError(printable(str(error), 700)) from None
    return list(done["remarks"]), ImportReport.model_validate_json(json.dumps(done["report"]))


def _lines(report: ImportReport, job: ImportJob, files: list[Path], out: Path) -> Iterator[str]:
    units = ("m/s", "rad/s") if report.metric else ("of full speed", "of full lock at full speed")
    made = ", ".join(
        f"{name} {count / report.ticks:.0%}" for name, count in report.atoms.items() if count
    )
    yield f"drives        {len(files)} ({report.successes} reached {job.goal})"
    yield f"frames        {report.ticks} ({report.ticks / 10:.0f} s)"
    yield f"nominal       {report.speed:.3g} {units[0]}, {report.turn_rate:.3g} {units[1]}"
    yield f"stands        below {job.still:g} of both; turns from {job.turning:g} of the turn rate on"
    yield f"atoms         {made}"
    yield f"odometry      {report.odometry}"
    yield f"recordings in {out}; next: smal learn {out} --out MODEL"

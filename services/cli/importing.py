"""``smal import``: convert recordings of other software."""

import json
from collections.abc import Iterator
from contextlib import closing
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Final

import typer
from typer import Argument, Option

from schemas.base import STILL, TICK_S, TURNING
from schemas.codec import printable
from services.cli import options, outputs
from services.experiments.progress import Bars
from services.experiments.words import remark
from services.importers.job import FORMATS, ROTATIONS_DEG, ImportJob, ImportReport, check_format
from services.importers.run import MOST_MEMORY
from services.importers.ticks import QUANTILE
from services.kit.errors import JobError, UsageError
from services.recordings.sink import free_path, publish
from smal.files.confined import ConfinedError, WorkLimits, confined, size_of

_WORK: Final = "services.importers.run:work"


@dataclass(frozen=True)
class Part:
    """Selected part of a source; the fields match `ImportJob`."""

    goal: options.GoalOfDrives = "victim"
    success: Annotated[
        bool | None, Option("--succeeded/--failed", help="Whether the drives reached the goal.")
    ] = None
    camera: Annotated[
        str | None, Option(help="Image topic, image feature or field, or folder of images.")
    ] = None
    rotate_deg: Annotated[
        int,
        Option("--rotate", metavar="DEG", help="Clockwise turn of all images: 90, 180 or 270."),
    ] = 0
    velocity: Annotated[str | None, Option(help="Source of the velocities; see above.")] = None
    odometry: Annotated[
        str | None, Option(help="Topic of the poses of a bag. [default: by content]")
    ] = None
    episodes: Annotated[
        list[str] | None,
        Option("--episode", help="Name of a drive to import, as in the source; repeatable."),
    ] = None
    from_s: Annotated[
        float,
        Option(
            "--from", min=0, metavar="S", help="Start of each drive, seconds from its first frame."
        ),
    ] = 0.0
    to_s: Annotated[
        float,
        Option(
            "--to",
            min=0,
            metavar="S",
            help="End of each drive, seconds from its first frame.",
            show_default=False,
        ),
    ] = 1e9
    robot: options.Robot = options.DEFAULT_ROBOT


@dataclass(frozen=True)
class SourceScale:
    """Meaning of the values of a source; the fields match `ImportJob`."""

    rate_hz: Annotated[
        float | None,
        Option("--rate", min=0.1, max=1000, metavar="HZ", help="Frame rate; see above."),
    ] = None
    speed: Annotated[
        float | None, Option(metavar="M_S", help="Speed of value 1 in metres per second.")
    ] = None
    turn_rate: Annotated[
        float | None,
        Option(
            metavar="RAD_S",
            help="Turn rate of value 1 in radians per second; below 0 if right is positive.",
        ),
    ] = None
    quantile: Annotated[float, Option(help="Share of moving samples below the nominal speed.")] = (
        QUANTILE
    )
    still: Annotated[
        float, Option(help="Fraction of nominal values below which the robot stands.")
    ] = STILL
    turning: Annotated[
        float, Option(help="Fraction of the nominal turn rate above which the robot turns.")
    ] = TURNING
    field_of_view_deg: Annotated[
        float | None,
        Option(
            "--field-of-view",
            min=5,
            max=220,
            metavar="DEG",
            help="Horizontal field of view of the camera. [default: the source's]",
        ),
    ] = None
    no_odometry: Annotated[
        bool, Option("--no-odometry", help="Omission of odometry from velocities.")
    ] = False


def import_recordings(
    *,
    format_: Annotated[str, Argument(metavar="FORMAT", help=f"Format: {', '.join(FORMATS)}.")],
    path: Annotated[Path, Argument(metavar="PATH", help="Folder of the source, or file of a bag.")],
    out: Annotated[Path, Option(help="Folder for the recordings, one MCAP file per drive.")] = Path(
        "recordings"
    ),
    part: Part,
    scale: SourceScale,
    json_file: options.JsonFile = None,
) -> None:
    """Convert recordings of other software for `smal learn`.

    rosbag2, rosbag1: a bag of ROS 2 (MCAP or SQLite) or ROS 1 with images and Twist, TwistStamped,
    Odometry or poses. Topics that fit the images are chosen and reported. Each bag of a folder is a
    drive, also in the folders below it. lerobot: a LeRobotDataset (v2.0, v2.1, v3.0) of a mobile
    base. donkeycar: a tub of version 1 or 2, or a folder of tubs. folder: images,
    or one video, and a drive.csv with the columns image (without a video), time_s, linear_m_s,
    angular_rad_s (optional: episode, success, x_m, y_m, heading_rad; these poses can replace the
    velocities); or a data set in the layout of TUM, KITTI or EuRoC with poses.

    Drives count as successful unless the source or --failed says otherwise. --velocity is the topic
    of a bag, LINEAR,ANGULAR of LeRobot (names or numbers), or STEERING,THROTTLE of a tub. A speed
    of 1 means 1 m/s (donkeycar: unknown). A turn rate of 1 means 1 rad/s (theta.vel: 1 degree/s).
    --rate replaces wrong times of a tub or a table. An option without effect on a source is an
    error. A drive that cannot be read is left out and reported if others can be read.

    Times in milliseconds, microseconds or nanoseconds and headings in degrees are converted, with
    a remark. Turns to the other side than those of the views are mirrored if only the velocities or
    only the odometry contradict the views; a remark names the remedy if both do.

    Recordings have 10 frames per second at any source rate. Velocities become the actions forward,
    backward, left, right and stop; --still and --turning set the limits as fractions of the robot's
    nominal speed and turn rate. Odometry is compared with velocities and views: resets are joined,
    and a drive is cut where its view jumps too. Omitted data are reported with their count, and
    repairs with their place. Upright JPEG images are copied unchanged; other formats and EXIF
    orientations are converted and counted. Images larger than 4096x3072 pixels are shrunk. Files
    outside PATH are never read.

    Example: smal import donkeycar tub --rate 20 --to 25 --out drives
    """
    form = check_format(format_)
    outputs.check_file(json_file, "--json")
    if part.to_s <= part.from_s:
        raise UsageError(f"--to {part.to_s:g}: not after --from {part.from_s:g}")
    if part.rotate_deg not in ROTATIONS_DEG:
        raise UsageError(f"--rotate {part.rotate_deg}: unsupported; choose 90, 180 or 270")
    options.existing(path, folder=True)
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
    """Run the job in a separate process; see `services.importers.run`."""
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
    yield f"frames        {report.ticks} ({report.ticks * TICK_S:.0f} s)"
    yield f"nominal       {report.speed:.3g} {units[0]}, {report.turn_rate:.3g} {units[1]}"
    yield (
        f"stands        below {job.still:g} of both; turns above {job.turning:g} of the turn rate"
    )
    yield f"actions       {made}"
    yield f"odometry      {report.odometry}"
    field_deg = report.field_of_view_deg
    unknown = "no calibration (--field-of-view); smal learn estimates it from the views"
    yield f"camera        {unknown if field_deg is None else f'{field_deg:.0f} degrees wide'}"
    yield f"recordings in {out}; next: smal learn {out} --out MODEL"

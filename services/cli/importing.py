"""``smal import``: recordings that somebody has already, to teach from."""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any, Final

import typer
from pydantic import ValidationError
from tqdm import tqdm

from schemas.codec import describe, printable
from services.cli import options, outputs
from services.cli.stack.child import tied
from services.importers.atoms import QUANTILE, STILL, TURNING
from services.importers.job import FORMATS, Job, Report, check_format
from services.kit.errors import JobError, UsageError
from services.recordings.sink import free_path, publish

_COMMAND: Final = (sys.executable, "-P", "-m", "services.importers.run")


def import_recordings(
    format_: Annotated[str, typer.Argument(metavar="FORMAT", help=f"One of {', '.join(FORMATS)}.")],
    path: Annotated[Path, typer.Argument(help="The source: a folder, or of a bag the file.")],
    out: Annotated[Path, typer.Option(help="Folder for the recordings, one MCAP file a drive.")] = Path("recordings"),
    goal: options.GoalOfDrives = "victim",
    failed: Annotated[
        bool | None,
        typer.Option(
            "--failed/--succeeded",
            help="Whether the drives reached the goal. [default: as the source says, or else that they did]",
        ),
    ] = None,
    camera: Annotated[str | None, typer.Option(help="Which camera: a bag's topic, a LeRobot feature.")] = None,
    velocity: Annotated[
        str | None, typer.Option(help="Which velocities: a bag's topic, or LINEAR,ANGULAR of a LeRobot action.")
    ] = None,
    episode: Annotated[
        list[str] | None, typer.Option(help="Only this drive, by the source's own name; may be repeated.")
    ] = None,
    from_s: Annotated[
        float, typer.Option("--from", min=0, metavar="S", help="Leave out each drive's first seconds.")
    ] = 0.0,
    to_s: Annotated[
        float | None, typer.Option("--to", min=0, metavar="S", help="Leave out what comes after so many seconds.")
    ] = None,
    rate: Annotated[
        float | None,
        typer.Option(min=0.1, max=1000, metavar="HZ", help="Frames a second, where the source's times are wrong."),
    ] = None,
    speed: Annotated[
        float | None,
        typer.Option(
            metavar="M_S", help="Metres a second that a speed of 1 stands for. [default: 1; of donkeycar unknown]"
        ),
    ] = None,
    turn_rate: Annotated[
        float | None,
        typer.Option(
            metavar="RAD_S",
            help="Radians a second that a turn rate of 1 stands for. [default: 1; of x.vel and theta.vel pi/180]",
        ),
    ] = None,
    quantile: Annotated[
        float, typer.Option(help="The nominal speed is that which so many of the moving samples do not exceed.")
    ] = QUANTILE,
    still: Annotated[
        float, typer.Option(help="Below this fraction of the nominal velocities the robot stands.")
    ] = STILL,
    turning: Annotated[float, typer.Option(help="From this fraction of the nominal turn rate on it turns.")] = TURNING,
    field_of_view: Annotated[
        float | None,
        typer.Option(
            min=5,
            max=170,
            metavar="DEG",
            help="Of the camera, across. [default: the source's, or learning estimates it]",
        ),
    ] = None,
    no_odometry: Annotated[
        bool, typer.Option("--no-odometry", help="Do not reckon a way from velocities where there is no odometry.")
    ] = False,
    robot: options.Robot = options.DEFAULT_ROBOT,
    json_file: options.JsonFile = None,
) -> None:
    """Make recordings that `smal learn` takes out of what somebody recorded with other software.

    rosbag2: a bag of ROS 2 (MCAP or SQLite) with images and Twist, TwistStamped or Odometry; a bag is one drive, and
    several go into one OUT, each by an import of its own. lerobot: a LeRobotDataset
    (v2.0, v2.1, v3.0) of a base. donkeycar: a tub of version 2. folder: images and a drive.csv with the columns image,
    time_s, linear_m_s, angular_rad_s (and episode, success, x_m, y_m, heading_rad).

    Whatever rate the source has, a recording has 10 frames a second. Velocities become the atoms forward, backward,
    left, right and stop by --still and --turning, fractions of the robot's own nominal speed and turn rate. What does
    not fit is counted and said. Images that are JPEG stay as they are. No file outside of PATH is read.

    Example: smal import donkeycar tub --rate 20 --to 25 --out drives
    """
    check_format(format_)
    outputs.check_file(json_file, "--json")
    if to_s is not None and to_s <= from_s:
        raise UsageError(f"--to {to_s:g}: is not after --from {from_s:g}")
    # What was not asked for has the job's own default.
    given: dict[str, Any] = {"to_s": to_s, "success": None if failed is None else not failed}
    given |= {"camera": camera, "velocity": velocity, "rate_hz": rate, "speed": speed, "turn_rate": turn_rate}
    if field_of_view is not None:
        given["focal"] = 0.5 / math.tan(math.radians(field_of_view) / 2.0)
    with outputs.made_folder(out, "--out"), outputs.workshop(out, ".import-") as folder:
        job = _job(
            {name: value for name, value in given.items() if value is not None},
            {"format": format_, "path": str(path), "folder": str(folder), "robot": robot, "goal": goal},
            {"reckon": not no_odometry, "from_s": from_s, "quantile": quantile, "still": still, "turning": turning},
            {"episodes": tuple(episode or ())},
        )
        remarks, report = _run(job)
        files = [_published(Path(file), out) for file in report.files]
    for remark in remarks:
        sys.stderr.write(f"smal: {remark}\n")
    if json_file is not None:
        content = report.model_dump(mode="json") | {"files": [str(file) for file in files], "remarks": remarks}
        outputs.write_json(json_file, "--json", content)
    typer.echo("\n".join(_lines(report, job, files, out)))


def _job(*given: dict[str, Any]) -> Job:
    try:
        return Job(**{name: value for each in given for name, value in each.items()})
    except ValidationError as error:
        raise UsageError(describe(error)) from None


def _published(file: Path, out: Path) -> Path:
    path = free_path(out, file.stem)
    publish(file, path)
    return path


def _run(job: Job) -> tuple[list[str], Report]:
    """Do the job in a process of its own; see `services.importers.run`."""
    # One thread: more of them would each take memory, and the bound is for all.
    environment = os.environ | {"OPENBLAS_NUM_THREADS": "1"}
    with subprocess.Popen(  # noqa: S603 - our own
        tied(*_COMMAND), stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, env=environment,
        text=True,
    ) as child:  # fmt: skip
        try:
            assert child.stdin is not None  # noqa: S101 - by PIPE
            with suppress(BrokenPipeError):
                child.stdin.write(job.model_dump_json())
                child.stdin.close()
            last = _listen(child)
            child.wait()
        except BaseException:
            child.kill()
            raise
    if "report" in last:
        return list(last["remarks"]), Report.model_validate_json(json.dumps(last["report"]))
    died = f"what decodes it broke down (status {child.returncode}); the source is damaged, or hostile"
    raise JobError(printable(last.get("error") or f"{job.path}: {died}", 700))


def _listen(child: subprocess.Popen[str]) -> dict[str, Any]:
    """Show the progress; return the last that was said."""
    last: dict[str, Any] = {}
    assert child.stdout is not None  # noqa: S101 - by PIPE
    with tqdm(desc="importing", unit="frame", dynamic_ncols=True, disable=None) as bar:
        for line in child.stdout:
            last = json.loads(line)
            if "done" in last:
                bar.total = last["total"]
                bar.update(last["done"] - bar.n)
    return last


def _lines(report: Report, job: Job, files: list[Path], out: Path) -> Iterator[str]:
    units = ("m/s", "rad/s") if report.metric else ("of full speed", "of full lock at full speed")
    made = ", ".join(f"{name} {count / report.ticks:.0%}" for name, count in report.atoms.items() if count)
    yield f"drives        {len(files)} ({report.successes} reached {job.goal})"
    yield f"frames        {report.ticks} ({report.ticks / 10:.0f} s)"
    yield f"nominal       {report.speed:.3g} {units[0]}, {report.turn_rate:.3g} {units[1]}"
    yield f"stands        below {job.still:g} of both; turns from {job.turning:g} of the turn rate on"
    yield f"atoms         {made}"
    yield f"odometry      {report.odometry}"
    yield f"recordings in {out}; next: smal learn {out} --out MODEL"

"""``smal export``: recordings for other software."""

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, cast

import typer
from typer import Argument, Option

from services.cli import outputs
from services.experiments.progress import bar_of
from services.experiments.words import remark
from services.exporters.drives import FORMATS, ExportedDrive, read, write
from services.importers.drive import Tally
from services.importers.job import Format, check_format
from services.recordings.dataset import find_recordings


def export_recordings(
    format_: Annotated[str, Argument(metavar="FORMAT", help=f"One of {', '.join(FORMATS)}.")],
    recordings: Annotated[list[Path], Argument(help="Recordings, or folders of them.")],
    out: Annotated[Path, Option(help="Folder to be made.")],
    speed: Annotated[
        float | None, Option(min=0, max=50, metavar="M_S", help="Forward. [default: odometry]")
    ] = None,
    turn_rate: Annotated[
        float | None, Option(min=0, max=100, metavar="RAD_S", help="Left. [default: same]")
    ] = None,
) -> None:
    """Write recordings as other software reads them.

    rosbag2: in OUT a bag for each drive, as `ros2 bag record -s mcap` writes them and Foxglove shows them: images,
    camera info, odometry, velocities on /cmd_vel, inertial measurements, tf. lerobot: one LeRobotDataset v3.0 with
    video. folder: images and a drive.csv. What `smal import` reads of them is the drive again.

    Atoms become velocities: how fast a robot's atoms are is the median over its recordings by the wheels, and is said.
    Features, beliefs and true poses are not exported. OUT appears when it is whole.

    Example: smal export rosbag2 drives --out bags
    """
    form = check_format(format_, FORMATS)
    files = find_recordings(recordings)
    tally = Tally()
    try:
        with outputs.new_folder(out, "--out") as folder:
            # disable=None: no bars in a log file or a pipe, where the remarks would drown in them.
            reading = bar_of(files, desc="reading", unit="file", disable=None)
            drives = read(reading, speed, turn_rate, tally)
            total = sum(len(drive.ticks) for drive in drives)
            with bar_of(desc="exporting", unit="tick", total=total, disable=None) as bar:
                write(form, drives, folder, tally, lambda: cast("None", bar.update()))
    finally:
        remark(tally.lines())
    typer.echo("\n".join(_lines(form, drives, out)))


def _lines(form: Format, drives: list[ExportedDrive], out: Path) -> Iterator[str]:
    frames = sum(drive.episode.frames for drive in drives)
    yield f"drives        {len(drives)} ({sum(drive.success for drive in drives)} reached their goal)"
    yield f"frames        {frames} ({frames / 10:.0f} s)"
    for robot, nominal in {drive.episode.robot: drive.nominal for drive in drives}.items():
        speed = nominal.speed
        turn_rate = nominal.turn_rate
        yield f"velocities    of {robot}: forward {speed.value:.3g} m/s ({speed.origin})"
        yield f"              left {turn_rate.value:.3g} rad/s ({turn_rate.origin})"
    example = {
        "rosbag2": f"ros2 bag play {out / drives[0].name}",
        "lerobot": f"LeRobotDataset('smal', root='{out}')",
    }
    yield f"{form} in {out}; next: {example.get(form, f'smal import folder {out}')}"

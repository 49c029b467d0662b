"""``smal export``: convert recordings for other software."""

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, cast

import typer
from typer import Argument, Option

from schemas.base import TICK_S
from services.cli import outputs
from services.experiments.progress import bar_of
from services.experiments.words import remark
from services.exporters.drives import FORMATS, ExportedDrive, read, write
from services.importers.drive import Tally
from services.importers.job import Format, check_format
from services.recordings.dataset import find_recordings


def export_recordings(
    format_: Annotated[str, Argument(metavar="FORMAT", help=f"Format: {', '.join(FORMATS)}.")],
    recordings: Annotated[list[Path], Argument(help="Recordings, or folders of recordings.")],
    out: Annotated[Path, Option(help="New folder for the result.")],
    speed: Annotated[
        float | None,
        Option(
            min=0,
            max=50,
            metavar="M_S",
            help="Speed of the action forward. [default: from odometry]",
        ),
    ] = None,
    turn_rate: Annotated[
        float | None,
        Option(
            min=0,
            max=100,
            metavar="RAD_S",
            help="Turn rate of the action left. [default: from odometry]",
        ),
    ] = None,
) -> None:
    """Convert recordings to the format of other software.

    rosbag2: one bag per drive in OUT, as `ros2 bag record -s mcap` writes it (also for Foxglove),
    with images, camera info, odometry, velocities on /cmd_vel, inertial measurements and tf.
    lerobot: one LeRobotDataset v3.0 with video. folder: images and a drive.csv. `smal import`
    restores the drives from each format.

    Actions become velocities. The speed and turn rate of a robot are the medians of its odometry
    over all recordings, and are reported. Features, beliefs and true poses are not exported. OUT
    appears only when the export is complete.

    Example: smal export rosbag2 drives --out bags
    """
    form = check_format(format_, FORMATS)
    files = find_recordings(recordings)
    tally = Tally()
    try:
        with outputs.new_folder(out, "--out") as folder:
            reading = bar_of(files, desc="reading", unit="file")
            drives = read(reading, speed, turn_rate, tally)
            total = sum(len(drive.ticks) for drive in drives)
            with bar_of(desc="exporting", unit="tick", total=total) as bar:
                write(form, drives, folder, tally, lambda: cast("None", bar.update()))
    finally:
        remark(tally.lines())
    typer.echo("\n".join(_lines(form, drives, out)))


def _lines(form: Format, drives: list[ExportedDrive], out: Path) -> Iterator[str]:
    frames = sum(drive.frames for drive in drives)
    yield f"drives        {len(drives)} ({sum(drive.success for drive in drives)} reached their goal)"
    yield f"frames        {frames} ({frames * TICK_S:.0f} s)"
    for robot, nominal in {drive.robot: drive.nominal for drive in drives}.items():
        speed = nominal.speed
        turn_rate = nominal.turn_rate
        yield f"velocities    of {robot}: forward {speed.value:.3g} m/s ({speed.origin})"
        yield f"              left {turn_rate.value:.3g} rad/s ({turn_rate.origin})"
    example = {
        "rosbag2": f"ros2 bag play {out / drives[0].name}",
        "lerobot": f"LeRobotDataset('smal', root='{out}')",
    }
    yield f"{form} in {out}; next: {example.get(form, f'smal import folder {out}')}"

"""``smal laps``: evaluate place recognition on laps of a real robot."""

from contextlib import closing
from pathlib import Path
from typing import Annotated

import typer
from typer import Argument, Option

from services.cli import outputs
from services.experiments.progress import Bars


def laps(
    source: Annotated[Path, Argument(help="Tub of donkeycar, recording, or folder of recordings.")],
    out: Annotated[Path, Option(help="Folder for the results.")],
    rate_hz: Annotated[
        float | None,
        Option(
            "--rate", min=0.1, max=1000, metavar="HZ", help="Frame rate of a tub with wrong times."
        ),
    ] = None,
) -> None:
    """Evaluate place recognition on laps of a real robot and write a page of results.

    SMAL learns one lap and localizes each frame of the other laps, with and without odometry. The
    page compares it with the nearest taught frame and with teach and repeat. The source needs three
    whole laps, which are detected by recurring views. The command takes some minutes.
    OUT/index.html is the page and OUT/results.json holds the numbers.

    Example: smal laps tub --out laps
    """
    from services.experiments.laps.asking import ask  # noqa: PLC0415 - what follows loads much
    from services.experiments.laps.report import write_page  # noqa: PLC0415
    from services.experiments.laps.source import read_laps  # noqa: PLC0415

    with closing(Bars()) as bar:
        found = read_laps(source, bar, rate_hz)
        outputs.make_folder(out, "--out")
        judged = ask(found, bar)
    typer.echo(f"results: {write_page(out, source, found, judged)}")

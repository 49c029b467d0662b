"""``smal model``: what a model has learned."""

from contextlib import closing
from pathlib import Path
from typing import Annotated

import typer
from typer import Argument, Option

from services.cli import options, outputs
from services.cli.adding import back, versions
from services.cli.grouping import STYLE
from services.experiments.progress import Bars, bar_of
from services.experiments.showing.summary import lines
from services.experiments.words import remark
from services.kit.errors import JobError, UsageError
from services.recordings.dataset import find_recordings

app = typer.Typer(
    help="Look at what was learned.\n\nExample: smal model show campus.smal --recordings drives --out shown",
    **STYLE,
)


@app.command("back")
def go_back(
    file: Annotated[
        Path, Argument(metavar="MODEL", help="Model file that `smal learn --add` changed.")
    ],
) -> None:
    """Put the version of a model in its place that it had before it last learned from runs.

    Example: smal model back campus.smal
    """
    typer.echo(
        f"{file}: is again what it was as {back(file)}; {len(versions(file))} earlier versions are left"
    )


@app.command("show")
def show(
    file: Annotated[Path, Argument(metavar="MODEL", help="Model file, made by `smal learn`.")],
    out: Annotated[Path | None, Option(help="Write a page with pictures to this folder.")] = None,
    recordings: Annotated[
        list[Path] | None, Option(help="What it was learned from; may be given again.")
    ] = None,
) -> None:
    """Say what a model is; with --out show it on a page.

    OUT/index.html shows the taught ways with the places where they part and meet, and the cost to go to each goal. A
    model keeps no images: with --recordings the page has some of each drive, and where the belief was wide when
    recognition follows them once more. The page needs nothing from a network.

    Example: smal model show campus.smal --recordings drives --out shown
    """
    model = options.loaded(file)
    if out is None:
        if recordings:
            raise UsageError("--recordings: what they show is for the page: give --out too")
        for line in lines(model, str(file), file.stat().st_size):
            typer.echo(line)
        return
    files = None if recordings is None else find_recordings(recordings)
    outputs.make_folder(out, "--out")
    # They load matplotlib and OpenCV.
    from services.experiments.showing.drives import find_drives  # noqa: PLC0415
    from services.experiments.showing.page import write_page  # noqa: PLC0415

    with closing(Bars()) as bars:
        found = None
        if files is not None:
            found = find_drives(model, bar_of(files, desc="reading", unit="file", disable=None))
            remark([*found.remarks, *(f"missing: {one}" for one in found.missing)])
        try:
            page = write_page(out, model, file, found, bars)
        except ValueError as error:
            raise JobError(f"{file}: {error}") from None
    typer.echo(f"results: {page}")

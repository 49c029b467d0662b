"""``smal model``: describe a model and restore earlier versions."""

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
    help="Describe a model, or restore an earlier version.\n\nExample: smal model show "
    "campus.smal --recordings drives --out shown",
    **STYLE,
)


@app.command("back")
def go_back(
    file: Annotated[
        Path, Argument(metavar="MODEL", help="Model file that `smal learn --add` changed.")
    ],
) -> None:
    """Restore the version of a model before its last extension.

    Example: smal model back campus.smal
    """
    typer.echo(f"{file}: restored from {back(file)}; {len(versions(file))} earlier versions left")


@app.command("show")
def show(
    file: Annotated[Path, Argument(metavar="MODEL", help="Model file, made by `smal learn`.")],
    out: Annotated[Path | None, Option(help="Folder for a page with pictures.")] = None,
    recordings: Annotated[
        list[Path] | None,
        Option(help="Recordings of the model, for images on the page; repeatable."),
    ] = None,
) -> None:
    """Describe a model; with --out, write a page about it.

    OUT/index.html shows the taught routes with their junctions and the cost to each goal. A model
    contains no images. With --recordings the page shows images of each drive, and the places where
    the localization of the same drives is uncertain. The page works offline.

    Example: smal model show campus.smal --recordings drives --out shown
    """
    model = options.loaded(file)
    if out is None:
        if recordings:
            raise UsageError("--recordings: only for the page; give --out too")
        for line in lines(model, str(file), file.stat().st_size):
            typer.echo(line)
        return
    files = None if recordings is None else find_recordings(recordings)
    outputs.make_folder(out, "--out")
    # Imported late: these modules load matplotlib and OpenCV.
    from services.experiments.showing.drives import find_drives  # noqa: PLC0415
    from services.experiments.showing.page import write_page  # noqa: PLC0415

    with closing(Bars()) as bars:
        found = None
        if files is not None:
            found = find_drives(model, bar_of(files, desc="reading", unit="file"))
            remark([*found.remarks, *(f"missing: {one}" for one in found.missing)])
        try:
            page = write_page(out, model, file, found, bars)
        except ValueError as error:
            raise JobError(f"{file}: {error}") from None
    typer.echo(f"results: {page}")

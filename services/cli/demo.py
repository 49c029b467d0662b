"""``smal demo``: teach, learn and run once, as a first look."""

import subprocess
import sys
import time
from pathlib import Path
from typing import Annotated, Final

import typer
from typer import Option

from services.cli import options, outputs
from services.cli.child import tied
from services.cli.stack import flags
from services.experiments.words import counted
from services.kit.errors import UsageError

_DRIVES: Final = 1
_RUNS: Final = 5
_SEED: Final = 1
_SMAL: Final = "from services.cli.main import main; main()"


def demo(
    *,
    world: Annotated[
        str | None,
        Option(
            envvar="SMAL_DEMO_WORLD",
            help="Name of a world, or file of a map or world. [default: campus; with --connect "
            "the robot's]",
        ),
    ] = None,
    drives: Annotated[
        int | None,
        Option(
            min=1,
            envvar="SMAL_DEMO_DRIVES",
            help=f"Number of drives that teach. [default: {_DRIVES}]",
        ),
    ] = None,
    runs: Annotated[
        int | None,
        Option(min=1, envvar="SMAL_DEMO_RUNS", help=f"Number of runs. [default: {_RUNS}]"),
    ] = None,
    seed: Annotated[
        int | None,
        Option(
            min=0,
            envvar="SMAL_DEMO_SEED",
            help=f"Seed of the first drive and run. [default: {_SEED}]",
        ),
    ] = None,
    camera: options.CameraSize = None,
    out: Annotated[
        Path | None,
        Option(
            envvar="SMAL_DEMO_OUT", help="Folder for the results. [default: out/demo-DATE-TIME]"
        ),
    ] = None,
    browser: Annotated[
        bool, Option("--browser", help="Page for driving in the browser, in place of runs.")
    ] = False,
    stack: options.RunOptions,
) -> None:
    """Show SMAL at work: check the machine, teach, learn, run, and open the page of results.

    A scripted expert drives to the victim once; then the robot finds it from other starts. The demo
    takes some minutes on two cores without a GPU. With --browser you drive by yourself, on a page
    in the browser.

    Example: smal demo

    Example: smal demo --browser
    """
    name = world or (None if stack.connect else options.DEFAULT_WORLD)
    size = None if camera is None else f"{camera.width}x{camera.height}"
    if browser:
        if stack.connect is not None:
            raise UsageError("--browser: unsupported with --connect; open the page of that stack")
        taught = {"drives": drives, "runs": runs, "seed": seed}
        options.refuse(taught, "with --browser, where you drive by yourself; leave it out")
    else:
        stack.refuse_secure()
    out = out or Path(f"out/demo-{time.strftime('%Y%m%d-%H%M%S')}")
    outputs.make_folder(out, "--out")
    if browser:
        more = flags(world=name, camera=size, root=out, robot=stack.robot, secure=stack.secure)
        _step("up", "--browser", *more)
        return
    drives = drives or _DRIVES
    runs = runs or _RUNS
    seed = _SEED if seed is None else seed
    to = {"connect": stack.connect, "secure": stack.secure, "robot": stack.robot}
    reach = flags(**to) if stack.connect is not None else ()
    same = (*flags(world=name, camera=size, seed=seed), *reach)
    learned = out / "model.smal"
    report = out / "report"
    typer.echo(f"This demo teaches with {counted(drives, 'drive')}, and runs {runs} times.")
    if stack.connect is None:
        typer.echo("\n1/4 Check the machine")
        _step("doctor")
    typer.echo("\n2/4 The expert drives to the victim; the recorder writes the drive")
    _step("demonstrate", *flags(episodes=drives, out=out / "drives"), *same)
    typer.echo("\n3/4 SMAL learns a map of views from the drive")
    _step("learn", str(out / "drives"), *flags(out=learned))
    typer.echo("\n4/4 The robot finds the victim by itself, from other starts")
    results = flags(model=learned, episodes=runs, json=out / "runs.json", report=report)
    _step("run", *results, *same)
    page = report.resolve() / "index.html"
    typer.echo(f"\nOpen this page: {page}")
    outputs.open_page(page.as_uri())


def _step(*arguments: str) -> None:
    """Run a command of SMAL; end with its exit status if it fails."""
    sys.stdout.flush()
    child = subprocess.Popen(tied(sys.executable, "-c", _SMAL, *arguments))  # noqa: S603 - our own
    try:
        status = child.wait()
    except KeyboardInterrupt:
        child.terminate()
        child.wait()
        raise
    if status:
        raise typer.Exit(status)

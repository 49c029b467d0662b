"""Entry point of the ``smal`` command.

A user error is printed as one line. The exit status is 2 for invalid usage, which includes paths that
do not exist, and 1 for a failed job, which includes files with unusable content.
"""

import sys
from importlib import import_module
from typing import Annotated, Any, Final, cast

try:
    import typer
except ModuleNotFoundError:
    sys.exit("smal: the command needs further packages: pip install 'smal[stack]'")
from typer import Option
from typer.core import TyperCommand, TyperGroup

from services.cli.grouping import STYLE, grouped
from services.cli.interrupts import interrupted_by_signals
from services.kit.errors import JobError, UsageError, describe_os_error, out_of_memory
from services.kit.version import program_version

_EXIT_FAILED = 1
_EXIT_USAGE = 2
_EXIT_INTERRUPTED = 130
#: Location and summary of each command. Modules are loaded on demand: all of them take seconds.
COMMANDS: Final = {
    "doctor": ("services.cli.doctor:doctor", "Check the requirements of SMAL on this machine."),
    "demo": ("services.cli.demo:demo", "Teach, learn and run once, as a first look."),
    "up": ("services.cli.up:up", "Start a whole stack and keep it running."),
    "demonstrate": (
        "services.cli.demonstrate:demonstrate",
        "Record demonstrations by a scripted expert.",
    ),
    "teleop": ("services.cli.teleop:teleop", "Drive a robot with the keyboard."),
    "import": (
        "services.cli.importing:import_recordings",
        "Convert recordings of other software.",
    ),
    "export": (
        "services.cli.exporting:export_recordings",
        "Convert recordings for other software.",
    ),
    "recording": (
        "services.cli.recording:app",
        "Describe, check and repair recordings.",
    ),
    "replay": (
        "services.cli.replay:replay",
        "Replay a recording in place of its robot.",
    ),
    "learn": ("services.cli.learn:learn", "Learn a model from recorded drives."),
    "paper": ("services.cli.paper:app", "Learn a model by the paper's scheme."),
    "model": ("services.cli.model:app", "Describe a model, or restore an earlier version."),
    "run": ("services.cli.run:run", "Run searches with a learned model and count successes."),
    "evaluate": ("services.cli.evaluate:evaluate", "Run the paper's experiments in simulation."),
    "laps": ("services.cli.laps:laps", "Evaluate place recognition on laps of a real robot."),
    "match": ("services.cli.match:match", "Match the places of two traverses."),
    "topic": ("services.cli.topic:app", "List topics; print and measure messages."),
    "secure": ("services.cli.secure:app", "Create and check the certificates of a robot's bus."),
    "world": ("services.cli.world:app", "Create and draw worlds."),
}


class _LazyGroup(TyperGroup):
    def __init__(self, *arguments: Any, **more: Any) -> None:  # noqa: ANN401
        super().__init__(*arguments, **more)
        #: Names only: listing and suggestions do not need the commands themselves.
        self.commands = dict.fromkeys(COMMANDS)  # type: ignore[assignment]

    def get_command(  # type: ignore[override]  # typer hides the classes
        self, ctx: typer.Context, cmd_name: str
    ) -> TyperGroup | TyperCommand | None:
        return _load(cmd_name) if cmd_name in COMMANDS else None

    def format_commands(self, ctx: typer.Context, formatter: Any) -> None:  # type: ignore[override]  # noqa: ANN401
        with formatter.section("Commands"):
            formatter.write_dl([(name, summary) for name, (_, summary) in COMMANDS.items()])


def _load(name: str) -> TyperGroup | TyperCommand:
    module, _, attribute = COMMANDS[name][0].partition(":")
    found = getattr(import_module(module), attribute)
    if not isinstance(found, typer.Typer):
        alone = typer.Typer(**STYLE | {"no_args_is_help": False})
        alone.command(name)(grouped(found))
        found = alone
    command = cast("TyperGroup | TyperCommand", typer.main.get_command(found))
    command.name = name
    for one in getattr(command, "commands", {name: command}).values():
        one.no_args_is_help = any(parameter.required for parameter in one.params)
    return command


app = typer.Typer(name="smal", cls=_LazyGroup, **STYLE)


def _version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"smal {program_version()}")
        raise typer.Exit


@app.callback()
def smal(
    version: Annotated[
        bool, Option("--version", callback=_version, is_eager=True, help="Version of SMAL.")
    ] = False,
) -> None:
    """Teach a robot to find a target by driving it there once; match places.

    Example: smal doctor
    """


def main() -> None:
    """Run the command line and exit."""
    try:
        with interrupted_by_signals():
            status = app(prog_name="smal", standalone_mode=False)
        if status == _EXIT_INTERRUPTED:
            raise KeyboardInterrupt
    except (Exception, KeyboardInterrupt) as error:  # noqa: BLE001 - what nobody expects is raised again
        message, status = _told(error)
        # Without arguments a command that needs some prints its help.
        sys.stderr.write(f"{message}\n" if message.startswith("Usage: ") else f"smal: {message}\n")
    sys.exit(status if isinstance(status, int) else 0)


def _told(error: BaseException) -> tuple[str, int]:
    """Return the message and the exit status of a user error; raise any other error again."""
    match error:
        case typer.BadParameter(
            __cause__=Exception() as why
        ):  # Typer repeats the text of pydantic's error.
            error.message = _told(why)[0].removeprefix("message: ")
            error.__cause__ = None
            return _told(error)
        case typer.TyperException():
            return error.format_message(), error.exit_code
        case UsageError():
            return str(error), _EXIT_USAGE
        case JobError():
            return str(error), _EXIT_FAILED
        case Exception() if out_of_memory(error):
            return (
                "out of memory; free some, or allow more (ulimit -v), and run the command again",
                _EXIT_FAILED,
            )
        case OSError():
            return describe_os_error(error), _EXIT_FAILED
        case KeyboardInterrupt() | typer.Abort():
            return "interrupted", _EXIT_INTERRUPTED
    # Imported late, because the cases above do not need it.
    from pydantic import ValidationError  # noqa: PLC0415

    from schemas.codec import describe  # noqa: PLC0415

    if isinstance(error, ValidationError):
        return describe(error), _EXIT_USAGE
    raise error

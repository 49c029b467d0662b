"""The ``smal`` command; an error that a user can cause is one line, with status 2 for bad use, 1 for a failed job."""

import sys
from importlib import import_module
from typing import Annotated, Any, Final, cast

import typer
from typer import Option
from typer.core import TyperCommand, TyperGroup

from services.cli.grouping import STYLE, grouped
from services.cli.interrupts import interrupted_by_signals
from services.kit.errors import JobError, UsageError, describe_os_error, out_of_memory
from services.kit.version import program_version

_EXIT_FAILED = 1
_EXIT_USAGE = 2
_EXIT_INTERRUPTED = 130
#: Where each command is, and what it does. Modules are loaded when a command runs: all of them take seconds.
COMMANDS: Final = {
    "doctor": ("services.cli.doctor:doctor", "Check that this machine has what it takes."),
    "up": ("services.cli.up:up", "Start the whole stack and keep it running."),
    "demonstrate": (
        "services.cli.demonstrate:demonstrate",
        "Let the scripted expert show the search.",
    ),
    "teleop": ("services.cli.teleop:teleop", "Drive with the keyboard."),
    "import": (
        "services.cli.importing:import_recordings",
        "Make recordings of what other software recorded.",
    ),
    "export": (
        "services.cli.exporting:export_recordings",
        "Write recordings as other software reads them.",
    ),
    "recording": (
        "services.cli.recording:app",
        "Tell what is in recordings; check and repair them.",
    ),
    "replay": (
        "services.cli.replay:replay",
        "Put a recording on the topics, in place of its robot.",
    ),
    "learn": ("services.cli.learn:learn", "Learn a model from recorded drives."),
    "paper": ("services.cli.paper:app", "Learn by the paper's scheme."),
    "model": ("services.cli.model:app", "Look at what was learned."),
    "run": ("services.cli.run:run", "Let the robot find the victim by itself."),
    "evaluate": ("services.cli.evaluate:evaluate", "Run the paper's experiments in simulation."),
    "laps": ("services.cli.laps:laps", "Evaluate place recognition on laps of a real robot."),
    "match": ("services.cli.match:match", "Match the places of two traverses."),
    "topic": ("services.cli.topic:app", "List the topics; listen to them."),
    "secure": ("services.cli.secure:app", "Make and check certificates: who may do what."),
    "world": ("services.cli.world:app", "Make worlds out of maps; draw them."),
}


class _LazyGroup(TyperGroup):
    def __init__(self, *arguments: Any, **more: Any) -> None:  # noqa: ANN401
        super().__init__(*arguments, **more)
        #: By name; what each is need not be known to list them, or to suggest others.
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
    return command


app = typer.Typer(name="smal", cls=_LazyGroup, **STYLE)


def _version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"smal {program_version()}")
        raise typer.Exit


@app.callback()
def smal(
    version: Annotated[
        bool, Option("--version", callback=_version, is_eager=True, help="Show the version.")
    ] = False,
) -> None:
    """Teach a robot to find a victim by driving it there; match places.

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
        # Called without arguments, a group of commands answers with its help.
        sys.stderr.write(f"{message}\n" if message.startswith("Usage: ") else f"smal: {message}\n")
    sys.exit(status if isinstance(status, int) else 0)


def _told(error: BaseException) -> tuple[str, int]:
    """Return what is told of an error in one line, and the exit status; raise one again that no user can cause."""
    match error:
        case typer.BadParameter(
            __cause__=Exception() as why
        ):  # Typer asks pydantic, and repeats what that says.
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
    # Loaded only here: what is above needs nothing of it.
    from pydantic import ValidationError  # noqa: PLC0415

    from schemas.codec import describe  # noqa: PLC0415

    if isinstance(error, ValidationError):
        return describe(error), _EXIT_USAGE
    raise error

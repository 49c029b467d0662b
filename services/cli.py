"""The ``smal`` command.

Every error that a user can cause is one line on standard error: exit status 2 for bad use, 1 for a failed job.
"""

from __future__ import annotations

import sys

import typer
from pydantic import ValidationError

from schemas.codec import describe
from services.bus import BusError, RpcError
from services.commands import bench, demonstrate, doctor, evaluate, learn, match, run, teleop, topic, tune, up, world
from services.commands.errors import JobError, UsageError, describe_os_error
from services.process import EXIT_FAILED, EXIT_USAGE, ServiceError

app = typer.Typer(
    name="smal",
    help="Teach a robot to find a victim by driving it there. Start with: smal doctor",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)
app.command("up")(up.up)
app.command("demonstrate")(demonstrate.demonstrate)
app.command("learn")(learn.learn)
app.command("run")(run.run)
app.command("match")(match.match)
app.command("evaluate")(evaluate.evaluate)
app.command("tune")(tune.tune)
app.command("teleop")(teleop.teleop)
app.command("doctor")(doctor.doctor)
app.command("bench", context_settings={"allow_extra_args": True, "ignore_unknown_options": True})(bench.bench)
app.add_typer(topic.app, name="topic")
app.add_typer(world.app, name="world")


def main() -> None:
    """Run the command line and exit."""
    try:
        status = app(standalone_mode=False)
    except typer.TyperException as error:
        status = _say(error.format_message(), error.exit_code)
    except UsageError as error:
        status = _say(str(error), EXIT_USAGE)
    except (JobError, ServiceError, BusError, RpcError) as error:
        status = _say(str(error), EXIT_FAILED)
    except ValidationError as error:
        status = _say(describe(error), EXIT_USAGE)
    except OSError as error:
        status = _say(describe_os_error(error), EXIT_FAILED)
    except (KeyboardInterrupt, typer.Abort):
        status = _say("interrupted", 130)
    sys.exit(status if isinstance(status, int) else 0)


def _say(message: str, status: int) -> int:
    # Called without arguments, a group of commands answers with its help.
    sys.stderr.write(f"{message}\n" if message.startswith("Usage: ") else f"smal: {message}\n")
    return status

"""``smal teleop``: drive with the keyboard."""

from __future__ import annotations

from typing import Annotated

import typer
from pydantic import ValidationError

from schemas.codec import describe
from services.cli.options import DEFAULT_ROBOT, GoalOfDrives, Robot, Router, Secure, settings_for
from services.kit.errors import UsageError
from services.teleop.config import TeleopSettings
from services.teleop.session import run
from services.teleop.terminal import NoTerminalError, require_terminal


def teleop(
    robot: Robot = DEFAULT_ROBOT,
    router: Router = None,
    secure: Secure = None,
    seed: Annotated[int | None, typer.Option(min=0, help="Seed of the first episode; random if not given.")] = None,
    goal: GoalOfDrives = "victim",
) -> None:
    """Drive with the keyboard: arrows or w a s d, held; n begins an episode.

    What you drive is recorded by the stack's recorder and teaches like the expert's drives.

    Example: smal teleop --seed 1
    """
    try:
        require_terminal()
        reached = settings_for(robot, router, secure)
        settings = TeleopSettings(**reached.model_dump(), seed=seed, goal=goal)
    except NoTerminalError as error:
        raise UsageError(str(error)) from None
    except ValidationError as error:
        raise UsageError(describe(error)) from None
    run(settings)

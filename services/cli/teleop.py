"""``smal teleop``: drive with the keyboard."""

from typing import Annotated

from typer import Option

from services.cli import options
from services.teleop.session import TeleopSettings, run
from services.teleop.terminal import require_terminal


def teleop(
    *,
    reach: options.Reach,
    seed: Annotated[
        int | None, Option(min=0, help="Seed of the first episode. [default: random]")
    ] = None,
    goal: options.GoalOfDrives = "victim",
) -> None:
    """Drive a robot with the keyboard: hold arrows or w a s d; n begins an episode.

    The stack's recorder records your drives; they teach like those of the expert.

    Example: smal teleop --seed 1
    """
    require_terminal()
    run(TeleopSettings(**reach.settings.model_dump(), seed=seed, goal=goal))

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
        int | None, Option(min=0, help="Seed of the first episode; random if not given.")
    ] = None,
    goal: options.GoalOfDrives = "victim",
) -> None:
    """Drive with the keyboard: arrows or w a s d, held; n begins an episode.

    What you drive is recorded by the stack's recorder and teaches like the expert's drives.

    Example: smal teleop --seed 1
    """
    require_terminal()
    run(TeleopSettings(**reach.settings.model_dump(), seed=seed, goal=goal))

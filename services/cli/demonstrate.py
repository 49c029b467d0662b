"""``smal demonstrate``: record drives of the scripted expert."""

from contextlib import closing
from pathlib import Path
from typing import Annotated

import typer
from tqdm import tqdm
from typer import Option

from schemas.episode import Purpose, in_words
from schemas.rpc import ResetRequest
from services.cli import options, outputs
from services.cli.episodes.client import EpisodeClient, EpisodeRecord
from services.cli.episodes.files import recording
from services.cli.stack import Access, flags, stack_for
from services.experiments.html import png
from services.experiments.words import counted
from services.expert.driver import DRIVE_TICKS, RECOVERY_TICKS, ExpertService
from services.kit.errors import UsageError
from smal.files.container import write_whole


def demonstrate(
    *,
    world: options.World = None,
    episodes: Annotated[
        int, Option(min=0, help="Number of full drives from the start to the goal.")
    ] = 1,
    recoveries: Annotated[
        int,
        Option(
            min=0,
            help="Number of short drives from beside the route back to it, for the paper's scheme.",
        ),
    ] = 0,
    seed: options.Seed = 1,
    goal: options.GoalOfDrives = "victim",
    out: Annotated[Path, Option(help="Folder for the recordings, one MCAP file per drive.")] = Path(
        "recordings"
    ),
    simulator: options.Simulator,
    stack: options.RunOptions,
) -> None:
    """Record demonstrations of the search, driven by a scripted expert.

    Without --connect the command starts a stack and stops it at the end. Drive k of each kind uses
    the seed SEED + k, so the same command reproduces the same drives.

    Example: smal demonstrate --world campus --seed 1 --out drives
    """
    chosen, name = stack.world(world)
    stack.refuse(simulator)
    kinds: dict[Purpose, tuple[int, int]] = {
        "drive": (episodes, DRIVE_TICKS),
        "recovery": (recoveries, RECOVERY_TICKS),
    }
    requests = [
        ResetRequest(seed=seed + k, purpose=purpose, goal=goal, driver="expert", max_ticks=ticks)
        for purpose, (count, ticks) in kinds.items()
        for k in range(count)
    ]
    if not requests:
        raise UsageError("--episodes 0 --recoveries 0: nothing to demonstrate")
    outputs.make_folder(out, "--out")
    services = ("router", "robot", "recorder")
    own = {
        "robot": simulator.flags(chosen),
        "recorder": flags(root=out.resolve()),
    }
    with stack_for(stack.settings, services, stack.robot, own) as access:
        recorded = _record(requests, access, out, None if name is None else chosen, name)
    typer.echo(
        f"recorded {counted(recorded, 'drive')} in {out}; next: smal learn {out} --out MODEL"
    )


def _record(
    requests: list[ResetRequest], access: Access, out: Path, world: str | None, name: str | None
) -> int:
    expert = ExpertService()
    records: list[EpisodeRecord] = []
    with closing(EpisodeClient("expert", access.settings)) as client:
        client.watch_poses(expert.handle)
        client.node.bus.wait_connected(5.0)
        with recording(client.node.bus, out, "--out") as recorded:
            driven = client.run_all(
                requests,
                access,
                "demonstrating",
                world=name,
                on_begin=expert.begin,
                done=lambda: expert.arrived,
            )
            for record in driven:
                _complain(record)
                records.append(record)
                if len(records) in {1, len(requests)}:
                    _draw(world, records, out / "drives.png")
    return len(recorded)


def _draw(world: str | None, records: list[EpisodeRecord], picture: Path) -> None:
    from services.cli.episodes.report import draw_routes, known_world  # noqa: PLC0415 - matplotlib takes a second to import

    write_whole(picture, png(draw_routes(known_world(world, records), records)))
    tqdm.write(f"picture of {counted(len(records), 'drive')}: {picture}")


def _complain(record: EpisodeRecord) -> None:
    purpose = record.request.purpose
    outcome = record.outcome
    if outcome == "collision" or (purpose == "drive" and outcome != "found"):
        tqdm.write(
            f"warning: {purpose} with seed {record.request.seed}: {in_words(outcome)}; smal learn "
            "ignores it"
        )

"""``smal demonstrate``: the scripted expert drives, the recorder writes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Annotated

import typer
from tqdm import tqdm

from schemas import topics
from schemas.rpc import ResetReply, ResetRequest
from services.cli import options, outputs
from services.cli.episodes.client import EpisodeClient, EpisodeRecord, check_world_of
from services.cli.episodes.recording import recording
from services.cli.feature_options import Modalities, feature_flags, features_of_own_stack
from services.cli.simulator_options import simulator_of_own_stack
from services.cli.stack.processes import Access, flags, stack_for
from services.expert.driver import DRIVE_TICKS, RECOVERY_TICKS
from services.expert.service import ExpertService
from services.kit.errors import UsageError


def demonstrate(
    world: options.WorldOfStack = None,
    episodes: Annotated[int, typer.Option(min=0, help="Full drives from the start to the victim.")] = 1,
    recoveries: Annotated[
        int, typer.Option(min=0, help="Short drives that begin off the route and come back, for the paper's scheme.")
    ] = 0,
    seed: options.Seed = 1,
    goal: options.GoalOfDrives = "victim",
    out: Annotated[Path, typer.Option(help="Folder for the recordings, one MCAP file a drive.")] = Path("recordings"),
    camera: options.OwnCameraSize = None,
    shake: options.Shake = None,
    base: options.Base = None,
    variation: options.Variation = None,
    modalities: Modalities = None,
    connect: options.Connect = None,
    secure: options.Secure = None,
    robot: options.Robot = options.DEFAULT_ROBOT,
) -> None:
    """Have the scripted expert demonstrate the search, and record it.

    Without --connect a stack of its own is started for the purpose, and ended after it. Episode k of a kind uses the
    seed SEED + k, so the same command makes the same drives.

    Example: smal demonstrate --world campus --seed 1 --out drives
    """
    chosen, name = options.world_of_stack(world, connect)
    asked = None if name is None else chosen
    simulator = simulator_of_own_stack(chosen, camera, connect, shake=shake, base=base, variation=variation)
    features = features_of_own_stack(modalities, connect)
    requests = list(_requests(episodes, recoveries, seed, options.check_goal(goal)))
    if not requests:
        raise UsageError("--episodes 0 --recoveries 0: nothing to demonstrate")
    outputs.make_folder(out, "--out")
    services = ("router", "robot", "features", "recorder")
    own = {
        "robot": simulator.flags(),
        "features": feature_flags(features),
        "recorder": flags(root=out.resolve()),
    }
    with stack_for(connect, services, robot, own, secure) as access:
        recorded = _record(requests, access, out, asked, name)
    typer.echo(f"recorded {recorded} drives in {out}; next: smal learn {out} --out MODEL")


def _requests(episodes: int, recoveries: int, seed: int, goal: str) -> Iterator[ResetRequest]:
    for k in range(episodes):
        yield ResetRequest(seed=seed + k, purpose="drive", goal=goal, driver="expert", max_ticks=DRIVE_TICKS)
    for k in range(recoveries):
        yield ResetRequest(seed=seed + k, purpose="recovery", goal=goal, driver="expert", max_ticks=RECOVERY_TICKS)


def _record(requests: list[ResetRequest], access: Access, out: Path, world: str | None, name: str | None) -> int:
    """Have every drive driven and recorded; return how many."""
    client = EpisodeClient("demonstrate", access.settings)
    expert = ExpertService()
    records: list[EpisodeRecord] = []
    client.watch_poses(expert.see)
    client.node.subscribe(topics.OBSERVATION, expert.handle, depth=4)
    try:
        client.node.bus.wait_connected(5.0)
        with recording(client.node.bus, out, "--out") as recorded:
            for request, progress in _with_progress(requests):
                record = client.run(
                    request,
                    on_begin=partial(_begin, expert, name),
                    done=lambda: expert.arrived,
                    on_tick=progress,
                    check=access.check,
                )
                _complain(record)
                records.append(record)
                if len(records) in {1, len(requests)}:
                    _draw(world, records, out / "drives.png")
    finally:
        client.close()
    return len(recorded.files)


def _begin(expert: ExpertService, world: str | None, reply: ResetReply) -> None:
    check_world_of(reply, world)
    expert.begin(reply)


def _with_progress(requests: list[ResetRequest]) -> Iterator[tuple[ResetRequest, Callable[[int], None]]]:
    """Give each request with a function that moves the bar; the estimate learns from the drives so far."""
    drive_ticks = 500.0
    with tqdm(desc="demonstrating", unit="frame", dynamic_ncols=True) as bar:
        driven: int = 0
        for k, request in enumerate(requests):
            left = sum(RECOVERY_TICKS if r.purpose == "recovery" else drive_ticks for r in requests[k:])
            bar.total = driven + round(left)
            bar.set_postfix_str(f"{request.purpose} {k + 1}/{len(requests)}")
            yield request, lambda tick, before=driven: bar.update(before + tick - bar.n)  # type: ignore[misc]
            if request.purpose == "drive":
                drive_ticks += (bar.n - driven - drive_ticks) / (k + 1)
            driven = int(bar.n)
        bar.total = driven


def _draw(world: str | None, records: list[EpisodeRecord], picture: Path) -> None:
    from services.cli.episodes.route_map import draw_routes  # noqa: PLC0415 - matplotlib takes a second to import

    draw_routes(world, records).savefig(picture, dpi=110)
    tqdm.write(f"picture of {len(records)} drives: {picture}")


def _complain(record: EpisodeRecord) -> None:
    name = f"{record.request.purpose} with seed {record.request.seed}"
    if record.outcome == "collision":
        tqdm.write(f"warning: {name} ended in a collision; smal learn leaves it out")
    elif record.request.purpose == "drive" and record.outcome != "found":
        tqdm.write(f"warning: {name} did not reach the victim ({record.outcome}); smal learn leaves it out")

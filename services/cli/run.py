"""``smal run``: the robot searches by itself with a learned model."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from functools import partial
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from tqdm import tqdm

from schemas.rpc import MAX_TICKS, LoadReply, LoadRequest, Mode, Nothing, ResetRequest, Start, Status
from services.cli import options, outputs
from services.cli.episodes.client import EpisodeClient, EpisodeRecord, check_world_of
from services.cli.episodes.names import name_for
from services.cli.episodes.recording import recording
from services.cli.feature_options import ModalitiesOrOfModel, feature_flags, features_for_model, features_of_own_stack
from services.cli.simulator_options import simulator_of_own_stack
from services.cli.stack.processes import Access, flags, stack_for
from services.kit.errors import JobError
from services.kit.model_service import identity_of
from services.kit.settings import ServiceSettings
from smal.evaluation.success import wilson_interval
from smal.features import FeatureSettings
from smal.model import Model

#: Camera images kept of every run for the report, one in so many frames.
FRAMES_APART = 20
#: Frames after which a run times out, at least; and how many times those of the longest taught drive.
LEAST_TICKS, PATIENCE = 3000, 3
#: The services that work with the model.
CHAIN = ("recognition", "policy")


def run(
    model: options.ModelFile,
    world: options.WorldOfStack = None,
    episodes: Annotated[int, typer.Option(min=1, help="Runs.")] = 20,
    seed: options.Seed = 1,
    scheme: options.SchemeOption = None,
    stride: options.Stride = None,
    goal: options.Goal = None,
    start: Annotated[
        Start, typer.Option(help="Where runs begin: about the world's start, or anywhere beside the way to the victim.")
    ] = "start",
    kidnap: Annotated[
        int | None,
        typer.Option(min=1, metavar="TICK", help="Carry the robot to another place beside the way at this frame."),
    ] = None,
    realtime: Annotated[bool, typer.Option(help="Let the clock run, instead of waiting for every command.")] = False,
    max_ticks: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="Frames after which a run times out. [default: three times those of the longest taught drive, "
            f"at least {LEAST_TICKS}]",
        ),
    ] = None,
    json_file: Annotated[Path | None, typer.Option("--json", help="Write the results as JSON.")] = None,
    report: Annotated[Path | None, typer.Option(help="Write a page of results, with pictures, to this folder.")] = None,
    record: Annotated[Path | None, typer.Option(help="Record the runs into this folder.")] = None,
    camera: options.OwnCameraSize = None,
    shake: options.Shake = None,
    base: options.Base = None,
    variation: options.Variation = None,
    modalities: ModalitiesOrOfModel = None,
    connect: options.Connect = None,
    secure: options.Secure = None,
    robot: options.Robot = options.DEFAULT_ROBOT,
) -> None:
    """Let the robot find the victim by itself, and count how often it does.

    The starts differ from those of demonstrations with the same seed. Without --connect a stack of its own is started.

    Example: smal run --model campus.smal --world campus --episodes 20 --seed 1 --json runs.json
    """
    mode: Mode = "realtime" if realtime else "lockstep"
    loaded = options.read_model(model, scheme, stride, goal)
    identity = identity_of(loaded)
    chosen, name = options.world_of_stack(world, connect)
    asked = None if name is None else chosen
    simulator = simulator_of_own_stack(chosen, camera, connect, shake=shake, base=base, variation=variation)
    outputs.check_file(json_file, "--json", (chosen, model))
    for folder, option in ((report, "--report"), (record, "--record")):
        if folder is not None:
            outputs.make_folder(folder, option)
    services = ("router", "robot", "features", "recognition", "policy", *(["recorder"] if record else []))
    own = {"robot": simulator.flags()}
    if connect is None:
        own |= _own_flags(model, loaded.feature_settings, modalities, record)
    else:
        features_of_own_stack(modalities, connect)
    requests = [
        ResetRequest(
            seed=seed + k,
            purpose="run",
            driver="policy",
            mode=mode,
            max_ticks=max_ticks or min(max(LEAST_TICKS, PATIENCE * loaded.longest), MAX_TICKS),
            start=start,
            kidnap_tick=kidnap,
            goal=goal or (loaded.mapped.goals[0] if isinstance(loaded, Model) else "victim"),
        )
        for k in range(episodes)
    ]
    records: list[EpisodeRecord] = []
    try:
        with (
            stack_for(connect, services, robot, own, secure) as access,
            _client(access.settings, model, identity, stride, goal) as client,
            recording(client.node.bus, record, "--record") if record else nullcontext(),
        ):
            _check_features(client, loaded.feature_settings)
            for one in _run_all(client, requests, access, name):
                _check_models(client, identity, goal)
                records.append(one)
    finally:
        # Also when a later run fails, or is interrupted: the finished ones have cost their time.
        if json_file is not None and records:
            outputs.write_json(json_file, "--json", summarize(asked, records))
    summary = summarize(asked, records)
    if report is not None:
        from services.cli.episodes.report import write_report  # noqa: PLC0415 - matplotlib takes a second to import

        typer.echo(f"results: {write_report(report, asked, loaded, records, summary)}")
    found = sum(r.outcome == "found" for r in records)
    low, high = wilson_interval(found, len(records))
    typer.echo(f"found the victim in {found} of {len(records)} runs (95 % interval {low:.2f} to {high:.2f})")


def summarize(world: str | None, records: list[EpisodeRecord]) -> dict[str, object]:
    """Return the results as ``--json`` writes them; the robot says where it is unless a world was asked for."""
    found = sum(record.outcome == "found" for record in records)
    latencies = [ms for record in records for ms in record.decision_latencies_ms]
    p50, p95 = np.percentile(latencies, [50, 95]) if latencies else (None, None)
    return {
        "world": world or records[0].world,
        "episodes": [
            {
                "seed": record.request.seed,
                "outcome": record.outcome,
                "ticks": record.ticks,
                "decisions": len(record.decisions),
                "unknown": record.unknown,
            }
            for record in records
        ],
        "success_rate": found / len(records),
        "wilson_95": list(wilson_interval(found, len(records))),
        "decision_latency_ms": {
            "p50": None if p50 is None else round(float(p50), 3),
            "p95": None if p95 is None else round(float(p95), 3),
        },
    }


def _own_flags(
    model: Path, learned_on: FeatureSettings, modalities: str | None, record: Path | None
) -> dict[str, tuple[str, ...]]:
    """Return the flags of the services of an own stack that make the features, and read and write files."""
    chain = flags(root=model.resolve().parent)
    return {
        "features": feature_flags(features_for_model(modalities, learned_on)),
        "recognition": chain,
        "policy": chain,
        "recorder": flags(root=record and record.resolve()),
    }


@contextmanager
def _client(
    settings: ServiceSettings, model: Path, identity: str, stride: int | None, goal: str | None
) -> Iterator[EpisodeClient]:
    """Connect, and have recognition and policy load the model."""
    client = EpisodeClient("run", settings)
    try:
        client.watch_poses()
        client.watch_frames(FRAMES_APART)
        client.node.bus.wait_connected(5.0)
        for service in CHAIN:
            name = name_for(client.node.bus, service, model, "--model")
            request = LoadRequest(model=name, stride=stride, goal=goal)
            client.node.bus.call(service, "load", request, LoadReply, timeout_s=60.0)
        _check_models(client, identity, goal)
        yield client
    finally:
        client.close()


def _check_features(client: EpisodeClient, wanted: FeatureSettings) -> None:
    """Ask the features service whether it makes what the model was learned on.

    Raises
    ------
    JobError
        When it does not: recognition would refuse every frame.
    """
    detail = client.node.bus.call("features", "status", Nothing(), Status).detail
    if detail.get("fingerprint") != wanted.fingerprint:
        names = ",".join(wanted.modalities)
        made = str(detail.get("modalities")).replace(" ", ",")
        raise JobError(
            f"the model was learned on the features {names}, and the stack makes {made}; "
            f"start it with `smal up --modalities {names}`"
        )


def _check_models(client: EpisodeClient, identity: str, goal: str | None) -> None:
    """Ask recognition and policy whether they work with the model whose results these are to be.

    Raises
    ------
    JobError
        When one does not: the file was replaced, or the service was started again, with the model of its stack.
    """
    for service in CHAIN:
        detail = client.node.bus.call(service, "status", Nothing(), Status).detail
        for name, wanted in (("model", identity), ("goal", goal)):
            found = detail.get("checksum" if name == "model" else "goal")
            if found != wanted:
                raise JobError(
                    f"{service} has {name} {found or 'none'}, not {wanted or 'none'} as --{name}; "
                    "it was started again, or loaded another one: run again"
                )


def _run_all(
    client: EpisodeClient, requests: list[ResetRequest], access: Access, world: str | None
) -> Iterator[EpisodeRecord]:
    """Give every run as it ends; one that was aborted is an error, since it says nothing of the model."""
    outcomes: list[str] = []
    with tqdm(requests, desc="running", unit="run", dynamic_ncols=True) as bar:

        def show(tick: int) -> None:
            bar.set_postfix_str(f"{outcomes.count('found')} of {len(outcomes)} found, frame {tick}")

        for request in bar:
            record = client.run(
                request, on_begin=partial(check_world_of, wanted=world), on_tick=show, check=access.check
            )
            if record.outcome == "aborted":
                where = f" ({access.logs})" if access.logs else ""
                raise JobError(
                    f"run with seed {request.seed}: no command came; see the logs of recognition and policy{where}"
                )
            outcomes.append(record.outcome)
            show(record.ticks)
            yield record

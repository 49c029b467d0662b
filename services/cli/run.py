"""``smal run``: the robot searches by itself with a learned model."""

from collections import Counter
from contextlib import closing, nullcontext
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from typer import Option

from schemas.episode import in_words
from schemas.rpc import LoadReply, LoadRequest, Nothing, ResetRequest, Start, Status
from services.cli import options, outputs
from services.cli.episodes.client import EpisodeClient, EpisodeRecord
from services.cli.episodes.files import name_for, recording
from services.cli.stack import flags, stack_for
from services.experiments.words import counted
from services.kit.bus import Bus
from services.kit.errors import JobError
from services.kit.model_service import identity_of, most_ticks
from services.table import CHAIN
from smal.evaluation.precision_recall import wilson_interval
from smal.features import FeatureSettings
from smal.model import Model

FRAMES_APART = 20  # Camera images kept of every run for the report, one in so many frames.


def run(
    *,
    model: Annotated[Path, Option(help="Model file, made by `smal learn`.")],
    world: options.World = None,
    episodes: Annotated[int, Option(min=1, help="Runs.")] = 20,
    seed: options.Seed = 1,
    use: options.Use,
    start: Annotated[
        Start, Option(help="Begin about the world's start, or anywhere beside the way.")
    ] = "start",
    kidnap: Annotated[
        int | None, Option(min=1, metavar="TICK", help="Carry the robot away at this frame.")
    ] = None,
    changes: options.Changes,
    realtime: Annotated[
        bool, Option(help="Let the clock run, instead of waiting for every command.")
    ] = False,
    max_ticks: Annotated[
        int | None, Option(min=1, help="Frames after which a run times out.")
    ] = None,
    json_file: options.JsonFile = None,
    report: Annotated[
        Path | None, Option(help="Write a page of results, with pictures, to this folder.")
    ] = None,
    record: Annotated[Path | None, Option(help="Record the runs into this folder.")] = None,
    simulator: options.Simulator,
    modalities: options.Modalities = None,
    stack: options.RunOptions,
) -> None:
    """Let the robot find the victim by itself, and count how often it does.

    The starts differ from those of demonstrations with the same seed. Without --connect a stack of its own is started.

    A robot that --kidnap carries away goes on at another place beside the way. Without --max-ticks a run times out
    after three times the frames of the longest taught drive, and at least 3000.

    Example: smal run --model campus.smal --world campus --episodes 20 --seed 1 --json runs.json

    Example: smal run --model campus.smal --world campus --obstacles 3 --people 2 --report results
    """
    loaded = options.read_model(model, use)
    chosen, name = stack.world(world)
    asked = None if name is None else chosen
    stack.refuse(simulator, modalities)
    outputs.check_file(json_file, "--json", (chosen, model))
    for folder, option in ((report, "--report"), (record, "--record")):
        if folder is not None:
            outputs.make_folder(folder, option)
    services = ("router", "robot", "features", *CHAIN, *(["recorder"] if record else []))
    own = dict.fromkeys(CHAIN, flags(root=model.resolve().parent)) | {
        "robot": simulator.flags(chosen),
        "recorder": flags(root=record and record.resolve()),
    }
    if stack.connect is None:
        own["features"] = options.feature_flags(modalities, loaded.feature_settings)
    requests = [
        ResetRequest(
            seed=seed + k,
            purpose="run",
            driver="policy",
            mode="realtime" if realtime else "lockstep",
            max_ticks=max_ticks or most_ticks(loaded.longest),
            start=start,
            kidnap_tick=kidnap,
            until_said=isinstance(loaded, Model),  # The paper's scheme says nothing.
            goal=use.goal or (loaded.mapped.goals[0] if isinstance(loaded, Model) else "victim"),
            **asdict(changes),
        )
        for k in range(episodes)
    ]
    identity = identity_of(loaded)
    records: list[EpisodeRecord] = []
    try:
        with (
            stack_for(stack.settings, services, stack.robot, own) as access,
            closing(EpisodeClient("run", access.settings)) as client,
        ):
            bus = client.node.bus
            client.watch_poses()
            client.watch_frames(FRAMES_APART)
            bus.wait_connected(5.0)
            _load(bus, model, use)
            _check_models(bus, identity, use.goal)
            with recording(bus, record, "--record") if record else nullcontext():
                _check_features(bus, loaded.feature_settings)
                for one in client.run_all(requests, access, "running", world=name):
                    if one.outcome == "aborted":  # It says nothing of the model.
                        seed = one.request.seed
                        where = f" ({access.logs})" if access.logs else ""
                        logs = f"see the logs of recognition and policy{where}"
                        raise JobError(f"run with seed {seed}: no command came; {logs}")
                    _check_models(bus, identity, use.goal)
                    records.append(one)
    finally:
        # Also when a later run fails, or is interrupted: the finished ones have cost their time.
        if json_file is not None and records:
            outputs.write_json(json_file, "--json", summarize(asked, records))
    summary = summarize(asked, records)
    if report is not None:
        from services.cli.episodes.report import write_report  # noqa: PLC0415 - matplotlib takes a second to import

        typer.echo(f"results: {write_report(report, asked, loaded, records, summary)}")
    found = round(summary["success_rate"] * len(records))
    (low, high) = summary["wilson_95"]
    typer.echo(
        f"found the victim in {found} of {counted(len(records), 'run')} (95 % interval {low:.2f} to {high:.2f})"
    )
    others = Counter(
        in_words(record.outcome, record.right) for record in records if record.outcome != "found"
    )
    if others:
        typer.echo("; ".join(f"{outcome}: {count}" for outcome, count in others.most_common()))


def summarize(world: str | None, records: list[EpisodeRecord]) -> dict[str, Any]:
    """Return the results as ``--json`` writes them; the robot says where it is unless a world was asked for."""
    found = sum(record.outcome == "found" for record in records)
    latencies = [
        ms
        for record in records
        for tick, ms in record.latencies_ms.items()
        if tick in record.decisions
    ]
    p50, p95 = np.percentile(latencies, [50, 95]).round(3).tolist() if latencies else (None, None)
    return {
        "world": world or records[0].world,
        "episodes": [
            {
                "seed": record.request.seed,
                "outcome": record.outcome,
                "right": record.right,
                "ticks": record.ticks,
                "decisions": len(record.decisions),
                "unknown": len(record.unrecognized),
            }
            for record in records
        ],
        "success_rate": found / len(records),
        "wilson_95": list(wilson_interval(found, len(records))),
        "decision_latency_ms": {"p50": p50, "p95": p95},
    }


def _load(bus: Bus, model: Path, use: options.Use) -> None:
    for service in CHAIN:
        request = LoadRequest(
            model=name_for(bus, service, model, "--model"), stride=use.stride, goal=use.goal
        )
        bus.call(service, "load", request, LoadReply, timeout_s=60.0)


def _check_features(bus: Bus, wanted: FeatureSettings) -> None:
    """Refuse a stack that makes other features than the model was learned on: recognition would take no frame."""
    detail = bus.call("features", "status", Nothing(), Status).detail
    if detail.get("fingerprint") != wanted.fingerprint:
        names = ",".join(wanted.modalities)
        made = str(detail.get("modalities")).replace(" ", ",")
        raise JobError(
            f"the model was learned on the features {names}, and the stack makes {made}; "
            f"start it with `smal up --modalities {names}`"
        )


def _check_models(bus: Bus, identity: str, goal: str | None) -> None:
    """Refuse results of another model: services that were started again have that of their stack."""
    for service in CHAIN:
        detail = bus.call(service, "status", Nothing(), Status).detail
        for name, found, wanted in (
            ("model", detail.get("checksum"), identity),
            ("goal", detail.get("goal"), goal),
        ):
            if found != wanted:
                raise JobError(
                    f"{service} has {name} {found or 'none'}, not {wanted or 'none'} as --{name}; "
                    "it was started again, or loaded another one: run again"
                )

"""``smal run``: search with a learned model."""

from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import closing, nullcontext
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import typer
from typer import Option

from schemas.episode import in_words
from schemas.rpc import LoadReply, LoadRequest, Nothing, ResetRequest, Start, Status
from services.cli import options, outputs
from services.cli.episodes.client import EpisodeClient, EpisodeRecord
from services.cli.episodes.files import name_for, recording
from services.cli.stack import Access, flags, stack_for
from services.experiments.words import counted, remark
from services.kit.bus import Bus
from services.kit.errors import JobError
from services.kit.model_service import AnyModel, identity_of, most_ticks
from services.table import CHAIN
from smal.evaluation.precision_recall import wilson_interval
from smal.features import FeatureSettings
from smal.model import Model

FRAMES_APART = 10  # Spacing of the camera images for the report, frames.


@dataclass(frozen=True)
class Runs:
    """Number, start and end of the runs."""

    episodes: Annotated[int, Option(min=1, help="Number of runs.")] = 20
    seed: options.Seed = 1
    start: Annotated[
        Start,
        Option(
            help="Start: near the world's start, the same turned round, anywhere beside the "
            "route, or where a simulated robot stands."
        ),
    ] = "start"
    kidnap: Annotated[
        int | None,
        Option(
            min=1, metavar="TICK", help="Frame at which the robot is moved elsewhere (kidnapped)."
        ),
    ] = None
    realtime: Annotated[
        bool, Option(help="Real-time clock, instead of waiting for every command.")
    ] = False
    max_ticks: Annotated[int | None, Option(min=1, help="Maximum number of frames of a run.")] = (
        None
    )

    def requests(
        self, model: AnyModel, goal: str | None, changes: options.Changes
    ) -> list[ResetRequest]:
        """Return the request of each run."""
        mapped = model.mapped if isinstance(model, Model) else None
        first = ResetRequest(
            seed=self.seed,
            purpose="run",
            driver="policy",
            mode="realtime" if self.realtime else "lockstep",
            max_ticks=self.max_ticks or most_ticks(model.longest),
            start=self.start,
            kidnap_tick=self.kidnap,
            until_said=mapped is not None,  # The paper's scheme announces no end.
            goal=goal or ("victim" if mapped is None else mapped.goals[0]),
            **asdict(changes),
        )
        return [first.model_copy(update={"seed": self.seed + k}) for k in range(self.episodes)]


@dataclass(frozen=True)
class RunFiles:
    """Files of the results."""

    json_file: options.JsonFile = None
    report: Annotated[Path | None, Option(help="Folder for a page of results with pictures.")] = (
        None
    )
    record: Annotated[Path | None, Option(help="Folder for recordings of the runs.")] = None

    def check(self, read: tuple[str | Path, ...]) -> None:
        """Create the folders and check that the file differs from all input."""
        outputs.check_file(self.json_file, "--json", read)
        for folder, option in ((self.report, "--report"), (self.record, "--record")):
            if folder is not None:
                outputs.make_folder(folder, option)


def run(
    *,
    model: Annotated[Path, Option(help="Model file, created by `smal learn`.")],
    world: options.World = None,
    runs: Runs,
    use: options.Use,
    changes: options.Changes,
    files: RunFiles,
    simulator: options.Simulator,
    modalities: options.Modalities = None,
    stack: options.RunOptions,
) -> None:
    """Run searches with a learned model and count the successes.

    The starts differ from those of demonstrations with the same seed. Without --connect the command
    starts a stack and stops it at the end.

    With --kidnap the robot is moved to another place beside the route during the run. Without
    --max-ticks a run times out after three times the longest taught drive, at least 3000 frames.

    Example: smal run --model campus.smal --world campus --episodes 20 --seed 1 --json runs.json

    Example: smal run --model campus.smal --world campus --obstacles 3 --people 2 --report results
    """
    loaded = options.read_model(model, use)
    chosen, name = stack.world(world)
    asked = None if name is None else chosen
    taught_in = loaded.world if isinstance(loaded, Model) else ""
    if name is not None and taught_in not in ("", name):
        remark([f"warning: {model} was taught in {taught_in}, and the robot is in {name}"])
    stack.refuse(simulator, modalities)
    files.check((chosen, model))
    services = ("router", "robot", "features", *CHAIN, *(["recorder"] if files.record else []))
    own = dict.fromkeys(CHAIN, flags(root=model.resolve().parent)) | {
        "robot": simulator.flags(chosen),
        "recorder": flags(root=files.record and files.record.resolve()),
    }
    if stack.connect is None:
        own["features"] = options.feature_flags(modalities, loaded.feature_settings)
    requests = runs.requests(loaded, use.goal, changes)
    records: list[EpisodeRecord] = []
    try:
        with stack_for(stack.settings, services, stack.robot, own) as access:
            searcher = _Searcher(model, loaded, use)
            records.extend(_run_all(requests, access, searcher, files, name))
    finally:
        # Keep the results of finished runs after a failure or an interruption.
        if files.json_file is not None and records:
            outputs.write_json(files.json_file, "--json", summarize(asked, records))
    summary = summarize(asked, records)
    if files.report is not None:
        from services.cli.episodes.report import write_report  # noqa: PLC0415 - matplotlib takes a second to import

        typer.echo(
            f"results: {write_report(files.report, asked, (model, loaded), records, summary)}"
        )
    typer.echo("\n".join(_lines(summary, records)))


class _Searcher(NamedTuple):
    """A model and its use."""

    path: Path
    model: AnyModel
    use: options.Use

    def load(self, bus: Bus) -> None:
        """Load the model in the services."""
        for service in CHAIN:
            name = name_for(bus, service, self.path, "--model")
            request = LoadRequest(model=name, stride=self.use.stride, goal=self.use.goal)
            bus.call(service, "load", request, LoadReply, timeout_s=60.0)
        self.check(bus)

    def check(self, bus: Bus) -> None:
        """Raise JobError if a service has another model: a restarted service loads the stack's model."""
        _check_models(bus, identity_of(self.model), self.use.goal)


def _run_all(
    requests: list[ResetRequest],
    access: Access,
    searcher: _Searcher,
    files: RunFiles,
    world: str | None,
) -> Iterator[EpisodeRecord]:
    with closing(EpisodeClient("run", access.settings)) as client:
        bus = client.node.bus
        client.watch_poses()
        client.watch_frames(FRAMES_APART)
        bus.wait_connected(5.0)
        searcher.load(bus)
        with recording(bus, files.record, "--record") if files.record else nullcontext():
            _check_features(bus, searcher.model.feature_settings)
            for one in client.run_all(requests, access, "running", world=world):
                if one.outcome == "aborted":  # A run without commands is not a result of the model.
                    where = f" ({access.logs})" if access.logs else ""
                    raise JobError(
                        f"run with seed {one.request.seed}: no command received; see the logs "
                        f"of recognition and policy{where}"
                    )
                searcher.check(bus)
                yield one


def _lines(summary: Mapping[str, Any], records: list[EpisodeRecord]) -> Iterator[str]:
    missed = [one for one in records if one.outcome != "found"]
    low, high = summary["wilson_95"]
    yield (
        f"found the victim in {len(records) - len(missed)} of {counted(len(records), 'run')} "
        f"(95 % interval {low:.2f} to {high:.2f})"
    )
    if missed:
        outcomes = Counter(in_words(one.outcome, one.right) for one in missed)
        yield "; ".join(f"{outcome}: {count}" for outcome, count in outcomes.most_common())


def summarize(world: str | None, records: list[EpisodeRecord]) -> dict[str, Any]:
    """Return the results for ``--json``; the world is the robot's unless one was requested."""
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
                "kidnapped": record.kidnapped,
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


def _check_features(bus: Bus, wanted: FeatureSettings) -> None:
    """Raise JobError unless the stack computes the features of the model."""
    detail = bus.call("features", "status", Nothing(), Status).detail
    if detail.get("fingerprint") != wanted.fingerprint:
        names = ",".join(wanted.modalities)
        made = str(detail.get("modalities")).replace(" ", ",")
        raise JobError(
            f"the model uses the features {names}, but the stack computes {made}; start it "
            f"with `smal up --modalities {names}`"
        )


def _check_models(bus: Bus, identity: str, goal: str | None) -> None:
    """Raise JobError unless the services use this model: a restarted service loads the stack's model."""
    for service in CHAIN:
        detail = bus.call(service, "status", Nothing(), Status).detail
        for name, found, wanted in (
            ("model", detail.get("checksum"), identity),
            ("goal", detail.get("goal"), goal),
        ):
            if found != wanted:
                raise JobError(
                    f"{service}: {name} is {found or 'none'}, not {wanted or 'none'} as "
                    f"--{name}; the service restarted or loaded another {name}: run again"
                )

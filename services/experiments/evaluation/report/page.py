"""Page of an evaluation, with its figures and numbers."""

import json
import platform
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final

from matplotlib.figure import Figure

from schemas.episode import Outcome
from services.experiments import html
from services.experiments.evaluation.degradation import DEGRADATIONS
from services.experiments.evaluation.drives import load_arrays
from services.experiments.evaluation.plan import (
    JUDGED_TICKS,
    QUERY_SEED,
    RUN_SEED,
    TEACHING_SEED,
    EvaluationPlan,
    WorldPlan,
)
from services.experiments.evaluation.report.figures import (
    example_route,
    found_by_drives,
    precision_recall,
    success_by_length,
)
from services.experiments.evaluation.report.summary import SOON_S, WorldResults, results_of
from services.experiments.evaluation.results import Results
from services.experiments.evaluation.tasks import TASKS
from services.experiments.evaluation.units import (
    Finding,
    LearnUnit,
    Query,
    Searches,
    Teach,
    Unit,
    code_fingerprint,
    units,
)
from services.experiments.words import counted
from services.kit.model_service import LEAST_TICKS
from services.kit.version import program_version
from smal.evaluation.precision_recall import wilson_interval
from smal.files.container import write_whole

_DPI: Final = 130
#: Outcomes of unsuccessful searches, with their headings.
FAILURES: Final[dict[Outcome, str]] = {
    "collision": "collisions", "timeout": "out of time", "missed": "missed", "false_goal": "false goals",
    "not_here": "“not here”",
}  # fmt: skip


def write_page(plan: EvaluationPlan, results: Results) -> Path:
    """Write ``index.html``, ``results.json`` and the figures of finished units; return the page."""
    planned = units(plan)
    findings = results.findings
    found = [results_of(world, planned, findings) for world in plan.worlds]
    seconds = sum(float(one["cpu_s"]) for one in findings.values())
    numbers = {
        "plan": plan.name,
        "version": program_version(),
        "units": {"planned": len(planned), "done": len(findings)},
        "machine_seconds": round(seconds, 1),
        "worlds": {one.world.title: one.as_json() for one in found},
    }
    write_whole(results.folder / "results.json", (json.dumps(numbers, indent=1) + "\n").encode())
    searches = (len(one["searches"]) for one in _of_kind(findings, Searches).values())
    frames = sum(one["frames"] for one in _of_kind(findings, Query).values())
    facts = {
        "worlds": ", ".join(world.title for world in plan.worlds),
        "searches": sum(searches),
        **({"held-out frames": f"{frames:,}"} if frames else {}),
        "processor time": f"{seconds / 60:.0f} min",
        "version": program_version(),
    }
    return html.write_page(
        results.folder,
        "evaluation.html",
        plan=plan,
        facts=facts,
        planned=len(planned),
        done=len(findings),
        worlds=found,
        figures={name: one for each in found for name, one in _saved_figures(each, results)},
        taught=[_taught(world, findings) for world in plan.worlds],
        machine=f"{platform.processor() or platform.machine()}, {platform.system()}, "
        f"Python {platform.python_version()}",
        version=program_version(),
        code=code_fingerprint()[:12],
        **_FIXED,
    )


#: Values of the template that do not depend on results.
_FIXED: Final[dict[str, Any]] = {
    "degradations": DEGRADATIONS,
    "failures": FAILURES,
    "judged_ticks": JUDGED_TICKS,
    "least_ticks": LEAST_TICKS,
    "seeds": {"teaching": TEACHING_SEED, "queries": QUERY_SEED, "runs": RUN_SEED},
    "soon_s": SOON_S,
    "tasks": TASKS,
    "wilson_interval": wilson_interval,
}


def _of_kind(findings: Mapping[Unit, Finding], kind: type[Unit]) -> dict[Unit, Finding]:
    return {unit: found for unit, found in findings.items() if isinstance(unit, kind)}


def _saved_figures(found: WorldResults, results: Results) -> Iterator[tuple[str, bytes]]:
    """Write the figures of a world as ``figures/NAME.png``; yield each name with its PNG."""
    folder = results.folder / "figures"
    folder.mkdir(exist_ok=True)
    for name, figure in _figures(found, results):
        data = html.png(figure, _DPI)
        write_whole(folder / f"{name}.png", data)
        yield name, data


def _figures(found: WorldResults, results: Results) -> Iterator[tuple[str, Figure]]:
    name = found.world.title
    successes = found.successes
    if found.recognized:
        drawn = precision_recall(found.recognized, f"State recognition, {name}")
        yield f"precision-recall-{name}", drawn
    counts = {one.trial.drives for one in successes if one.trial.condition == "as taught"}
    if len(counts) > 1:
        drawn = found_by_drives(successes, f"Searches that find the victim, {name}")
        yield f"drives-{name}", drawn
    if len({one.trial.length for one in successes} - {None}) > 1:
        drawn = success_by_length(successes, f"Success over sequence length, {name}")
        yield f"success-{name}", drawn
    for unit, one in _of_kind(results.findings, Searches).items():
        if unit.site.world == found.world.world and one.get("file"):
            route = load_arrays(unit.file(results.work))
            yield f"route-{name}", example_route(unit.site.world, route, f"A search in {name}")
            return


def _taught(world: WorldPlan, findings: Mapping[Unit, Finding]) -> dict[str, Any]:
    here = {unit: one for unit, one in findings.items() if unit.site.world == world.world}
    return {
        "world": world.title,
        "frames": [one["frames"] for one in _of_kind(here, Teach).values()],
        "states": [
            f"{one['states']} ({counted(len(unit.needs), 'drive')}, l = {unit.length})"
            for unit, one in here.items()
            if isinstance(unit, LearnUnit)
        ],
    }

"""The page of an evaluation: one HTML file that needs nothing beside it, and beside it every figure and number."""

import json
import platform
from collections.abc import Iterator
from functools import partial
from html import escape
from pathlib import Path
from typing import Final

from matplotlib.figure import Figure

from services.experiments import html
from services.experiments.evaluation.plan import QUERY_SEED, RUN_SEED, TEACHING_SEED, Plan
from services.experiments.evaluation.report.sections import recognition_section, search_section
from services.experiments.evaluation.report.summary import results_of
from services.experiments.evaluation.results import Results
from services.experiments.evaluation.units import Learn, Query, Searches, Teach, code_fingerprint, units
from services.experiments.words import counted
from services.kit.model_service import LEAST_TICKS
from services.kit.version import program_version

_DPI: Final = 130


def write_page(plan: Plan, results: Results) -> Path:
    """Write ``index.html``, ``results.json`` and the figures into the folder of the results; return the page.

    Where not all units of the plan are done, the page says so, and shows those that are.
    """
    planned, findings = units(plan), results.findings
    found = [results_of(world, planned, findings) for world in plan.worlds]
    numbers = {
        "plan": plan.name,
        "version": program_version(),
        "units": {"planned": len(planned), "done": len(findings)},
        "machine_seconds": round(_seconds(results), 1),
        "worlds": {one.world.title: one.as_json() for one in found},
    }
    (results.folder / "results.json").write_text(json.dumps(numbers, indent=1) + "\n", encoding="utf-8")
    put = partial(embed, results.folder / "figures")
    body = list(_introduction(plan, results))
    if len(findings) < len(planned):
        body.append(
            f"<p><b>Not all is done:</b> {len(findings):,} of {len(planned):,} units. What is shown is whole, with all "
            "of its runs; the rest is left out until it is.</p>"
        )
    for each in found:
        body.append(f"<h2>{escape(each.world.title.capitalize())}</h2>")
        if each.recognized:
            body += recognition_section(each, put)
        if each.successes:
            here = [one for one in findings if one.site.world == each.world.world and findings[one].get("file")]
            body += search_section(each, [one.file(results.work) for one in here if isinstance(one, Searches)], put)
    body += _method(plan, results)
    return html.write_page(results.folder, f"SMAL: evaluation in simulation ({plan.name})", body)


def embed(folder: Path, name: str, figure: Figure, caption: str) -> str:
    """Write a figure as ``NAME.png``, and return it as HTML with its caption, which is HTML too."""
    data = html.png(figure, _DPI)
    folder.mkdir(exist_ok=True)
    (folder / f"{name}.png").write_bytes(data)
    return f'<figure class="own">{html.image(data, name)}<figcaption>{caption}</figcaption></figure>'


def _seconds(results: Results) -> float:
    return sum(float(found["cpu_s"]) for found in results.findings.values())


def _introduction(plan: Plan, results: Results) -> Iterator[str]:
    yield (
        "<p>The experiments of Han, Yang, Zhang and Zhang, <em>Sequence-based Multimodal Apprenticeship Learning for "
        "Robot Perception and Decision Making</em> (ICRA 2017), repeated in simulation, and taken further. A scripted "
        "expert drives the robot to a victim; from camera images, keys and odometry SMAL learns a map of views, and "
        "the paper's scheme states, actions, transitions and a reward; then the robot searches by itself from other "
        "starts.</p>"
    )
    if plan.omitted:
        yield f"<p><b>This is the quick evaluation.</b> It leaves out: {'; '.join(map(escape, plan.omitted))}.</p>"
    found = results.findings
    yield html.tiles(
        {
            "worlds": ", ".join(world.title for world in plan.worlds),
            "searches": str(sum(len(found[one]["searches"]) for one in found if isinstance(one, Searches))),
            "held-out frames": f"{sum(found[one]['frames'] for one in found if isinstance(one, Query)):,}",
            "processor time": f"{_seconds(results) / 60:.0f} min",
            "version": program_version(),
        }
    )


def _method(plan: Plan, results: Results) -> Iterator[str]:
    width, height = plan.camera
    yield "<h2>Conditions</h2>"
    yield (
        f"<p>Simulated camera of {width}x{height} pixels, 10 frames a second, lockstep, driven wheels with mass. "
        f"Seeds: teaching {TEACHING_SEED} and following, held-out drives {QUERY_SEED} and following, searches "
        f"{RUN_SEED} and following (of another purpose, so that starts differ from those of teaching). A search ends "
        f"with a collision, the robot's word (found: false where the victim is not near and in view; or not here), for "
        f"drivers that say nothing with the victim found, or after {plan.patience:g} times "
        f"the frames of the longest taught drive (in smal run at least {LEAST_TICKS}): a slow robot fails as one "
        f"that is lost does. Teaching is never degraded. SPL is success weighted by path length (Anderson et al. "
        f"2018); aside is the distance from the taught ways, by the truth; wrong and sure are frames at which the "
        f"robot believes to be further from the truth than the criterion allows, and not to be lost. "
        f"Features: colour and HOG, the default. Same seeds give the same results on one machine.</p>"
    )
    rows = []
    for world in plan.worlds:
        here = {unit: found for unit, found in results.findings.items() if unit.site.world == world.world}
        frames = [found["frames"] for unit, found in here.items() if isinstance(unit, Teach)]
        states = ", ".join(f"{here[one]['states']} ({counted(len(one.needs), 'drive')}, l = {one.length})"
                           for one in here if isinstance(one, Learn) and one.length)  # fmt: skip
        rows.append([world.title, str(len(frames)), f"{sum(frames):,}", states])
    yield html.table(["world", "drives", "frames", "states learned"], rows, left=1)
    yield (
        f"<p>Machine: {escape(platform.processor() or platform.machine())}, {escape(platform.system())}, Python "
        f"{platform.python_version()}. Version {program_version()}, code {code_fingerprint()[:12]}.</p>"
    )

"""The part of the report about searches: how often and how well each driver finds the victim, and an example."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from services.experiments import html
from services.experiments.evaluation.drives import load_arrays
from services.experiments.evaluation.plan import CONTROLLERS, ERRANDS
from services.experiments.evaluation.report import figures
from services.experiments.evaluation.report.recognition_section import Put
from services.experiments.evaluation.report.summary import SOON_S, Success, WorldResults
from services.experiments.evaluation.results import Results, file_of
from smal.evaluation.success import wilson_interval


def search_section(found: WorldResults, results: Results, put: Put) -> Iterator[str]:
    """Write it as HTML, piece by piece."""
    name = found.world.title
    yield "<h3>Finding the victim</h3>"
    if any(one.trial.condition == "as taught" for one in found.successes):
        yield put(
            f"drives-{name}",
            figures.found_by_drives(found.successes, f"Searches that find the victim, {name}"),
            "The same drives and starts for all; no recoveries. Bars are Wilson's 95 % intervals. Starts were not used "
            "in teaching.",
        )
    if any(one.trial.start == "anywhere" for one in found.successes):
        yield put(
            f"convergence-{name}",
            figures.convergence(found.successes, f"Back to the taught way, {name}"),
            "Distance from the taught way in searches that begin beside it and turned away; each line is a search, the "
            "thick one the median of those that still go on.",
        )
    if len({one.trial.length for one in found.successes if one.trial.controller == "paper"}) > 1:
        yield put(
            f"success-{name}",
            figures.success_by_length(found.successes, f"Success over sequence length, {name}"),
            "Share of searches that find the victim without a collision, over l, by the paper's scheme (its figure of "
            "success rates in its parameter analysis). With l = 1 it is the single image.",
        )
    yield from _table(found.successes)
    if found.errands:
        yield from _errands(found)
    yield from _example(found, results, put)


def _table(found: Sequence[Success]) -> Iterator[str]:
    rows = []
    usual = [one for one in found if one.trial.condition == "as taught"]
    special = sorted((one for one in found if one not in usual), key=lambda one: (one.trial.condition, one.trial.title))
    for one in [*sorted(usual, key=lambda one: one.trial.drives), *special]:
        soon = one.right_soon
        rows.append([
            one.trial.condition, str(one.trial.drives), one.trial.title, one.said,
            "{:.0%} to {:.0%}".format(*one.wilson_95), str(one.ended("collision")), str(one.ended("timeout")),
            str(one.ended("false_goal")), "-" if one.spl is None else f"{one.spl:.2f}", f"{one.aside_rms_m:.2f}",
            f"{one.aside_max_m:.2f}", "-" if one.interventions_per_km is None else f"{one.interventions_per_km:.1f}",
            "-" if one.wrong_share is None else f"{one.wrong_share:.1%}",
            "-" if soon is None else f"{soon[0]} of {soon[1]}",
        ])  # fmt: skip
    yield html.table(
        ["condition", "drives", "driver", "found", "95 %", "collisions", "out of time", "false goals", "SPL",
         "aside, RMS m", "max m", "interventions a km", "wrong and sure", f"right within {SOON_S:g} s"],
        rows, left=3,
    )  # fmt: skip
    yield "<p>" + "; ".join(f"{name}: {how}" for name, how in CONTROLLERS.values()) + ".</p>"


def _errands(found: WorldResults) -> Iterator[str]:
    """Tell how errands went."""
    rows = []
    for name, one in found.errands.items():
        right = sum(outcome == one["right"] for outcome in one["outcomes"])
        rows.append([
            name, ERRANDS[name], f"{right} of {len(one['outcomes'])}", "{:.0%} to {:.0%}".format(
                *wilson_interval(right, len(one["outcomes"]))
            ), f"{sum(one['driven_m']) / len(one['driven_m']):.0f}", ", ".join(f"{way:.0f}" for way in one["taught_m"]),
        ])  # fmt: skip
    yield "<h3>Errands</h3>"
    yield "<p>What several drives together make possible: SMAL, each drive taught once, from untaught starts.</p>"
    yield html.table(["errand", "what", "right", "95 %", "driven m, mean", "taught drives, m"], rows, left=2)


def _example(found: WorldResults, results: Results, put: Put) -> Iterator[str]:
    """Show the first search of SMAL after one drive that found the victim."""
    name = found.world.title
    files = {
        unit["seed"]: file_of(results.work, unit)
        for unit, one in results.findings.items()
        if unit["world"] == found.world.world and unit.kind == "search" and one["file"] and one["outcome"] == "found"
    }
    yield "<h3>An example</h3>"
    if not files:
        yield "<p>No search of SMAL found the victim: no example.</p>"
        return
    seed = min(files)
    degraded = next((one.trial.degradation for one in found.successes if one.trial.degradation != "clean"), None)
    title = f"A search in the world {name}, seed {seed}"
    yield put(
        f"route-{name}",
        figures.example_route(found.world.world, load_arrays(files[seed]), seed, degraded, title),
        "The way of a successful search from a start that was not taught (arrow) to the victim (star), and what the "
        "camera saw at the numbered places (the paper's figures of route and observations). The lower row shows the "
        "same views under the declared degradation.",
    )

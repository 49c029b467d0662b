"""What the benchmark of the decision latency found, as figures, verdicts and tables."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import numpy as np

from schemas.rpc import LoadReply
from tests.benchmarks.latency.robot import Answers
from tests.benchmarks.results import Record, table

LIMIT_MS: Final = 100.0
#: How many times longer a decision may take while pages watch.
MOST_WATCHED: Final = 1.2
_SHOWN: Final = ("count", "missing", "p50_ms", "p95_ms", "p99_ms", "max_ms")


def figures_of(answers: Sequence[Answers], loaded: LoadReply) -> dict[str, Any]:
    """Summarize; a frame without a command counts as one that took for ever."""
    every = [one.latency_s.get(tick) for one in answers for tick in range(one.ticks)]
    decided = [one.latency_s.get(tick) for one in answers for tick in sorted(one.decided)]
    first = 1 if loaded.scheme == "filter" else loaded.sequence_length
    due = sum(max(0, 1 + (one.ticks - first) // loaded.stride) for one in answers)
    stages: dict[str, list[float]] = {}
    for one in answers:
        for name, times in one.stages_s.items():
            stages.setdefault(name, []).extend(times)
    return {
        "decisions": summary(decided) | {"due": due},
        "frames": summary(every),
        "refused": {reason: count for one in answers for reason, count in one.refused.items()},
        "sent_late_ms": 1e3 * max(one.late_s for one in answers),
        "stages": {name: summary(list(times)) for name, times in stages.items()},
    }


def summary(times_s: Sequence[float | None]) -> dict[str, Any]:
    """Give percentiles in milliseconds; None for one that was never answered."""
    taken = np.array([np.inf if one is None else 1e3 * one for one in times_s] or [np.inf])
    marks = {"p50_ms": 50, "p95_ms": 95, "p99_ms": 99, "max_ms": 100}
    values = {name: float(np.percentile(taken, mark, method="higher")) for name, mark in marks.items()}
    known: dict[str, Any] = {name: value if np.isfinite(value) else None for name, value in values.items()}
    return known | {"count": len(times_s), "missing": sum(one is None for one in times_s)}


def judge(one: dict[str, Any]) -> Record:
    """Compare with what we set out to reach."""
    p95 = one["decisions"]["p95_ms"]
    where = f"{one['scheme']}, {one['keyframes']:,} keyframes, {one['templates']:,} templates, {one['camera']}"
    met = p95 is not None and p95 < LIMIT_MS
    return {"target": f"decision latency p95 in ms, {where}", "measured": p95, "limit": f"under {LIMIT_MS:g}",
            "verdict": "met" if met else "not met"}  # fmt: skip


def judge_watched(quiet: dict[str, Any], watched: dict[str, Any]) -> Record:
    """Compare what pages that watch cost with what they may: in the median, or at the 95th percentile if it is more."""
    pairs = [(watched["decisions"][mark], quiet["decisions"][mark]) for mark in ("p50_ms", "p95_ms")]
    ratio = None if any(None in pair for pair in pairs) else max(one / other for one, other in pairs)
    where = f"{quiet['scheme']}, {quiet['camera']}, {watched['watchers']} watchers over none"
    met = ratio is not None and ratio <= MOST_WATCHED
    return {"target": f"decision latency, p50 or p95, {where}", "measured": ratio, "limit": f"{MOST_WATCHED:g} times",
            "verdict": "met" if met else "not met"}  # fmt: skip


def as_text(results: dict[str, Any]) -> str:
    """Write the tables."""
    rows: list[Record] = []
    stages: list[Record] = []
    for one in results["cases"]:
        case = {name: one[name] for name in ("scheme", "camera", "watchers", "keyframes", "templates")}
        rows += [case | {"of": what} | {k: one[what][k] for k in _SHOWN} for what in ("decisions", "frames")]
        stages += [case | {"until": name} | {k: figures[k] for k in _SHOWN} for name, figures in one["stages"].items()]
    loads = [{name: one[name] for name in ("scheme", "camera", "watchers")} | one["cores"] for one in results["cases"]]
    return (
        table("From the capture of a frame to its command, ms", rows)
        + table("From the capture of a frame to what came of it on the way, ms", stages)
        + table("Cores in use", loads)
        + table("Targets", results["targets"])
    )

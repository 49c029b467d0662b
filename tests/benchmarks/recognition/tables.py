"""The results of the benchmark of recognition as tables to read."""

from __future__ import annotations

from typing import Any

from tests.benchmarks.results import Record, table


def as_text(results: dict[str, Any]) -> str:
    """Show the results as tables."""
    curves = results["convergence"]
    return "".join([
        table("Time over one float32 product X^T Y (median and worst over queries)",
              [_row(one) for one in results["matching"]]),
        table("Memory", [_memory(one) for one in results["matching"]]),
        table("Growth: exponent of the time over n", results["growth"]),
        *_algorithm2(results["algorithm2"]),
        table("CVXPY with Clarabel", results["cvxpy"]),
        table("Convergence, ours", curves["ours"] if curves else []),
        table("Targets (median over queries)", results["targets"]),
        table("Left out", [{"what": what, "reason": reason} for what, reason in results["left_out"].items()]),
    ])  # fmt: skip


def _row(one: dict[str, Any]) -> Record:
    return {
        **{name: one[name] for name in ("dataset", "n", "m", "l")},
        "product ms": 1e3 * one["product_seconds"],
        "match ms": 1e3 * one["seconds"],
        "ratio": one["ratio"],
        "worst": one["ratio_worst"],
        "no match": one["queries_without_match"],
        "sequences": one["active_sequences"],
        "rows": one["active_rows"],
        "iterations": one["iterations"],
        "gap": one["duality_gap"],
        "converged": one["converged"],
    }


def _algorithm2(records: list[dict[str, Any]]) -> list[str]:
    whole = [one for one in records if "solve_seconds" not in one]
    single = [one for one in records if "solve_seconds" in one]
    return [
        table(title, [{name: value for name, value in one.items() if name != "measured"} for one in rows])
        for title, rows in (
            ("Algorithm 2 as published, whole runs to our objective", whole),
            (
                "Algorithm 2 as published, one solve timed, times l, times the iterations of the largest whole run",
                single,
            ),
        )
    ]


def _memory(one: dict[str, Any]) -> Record:
    peak = one["solve_peak_memory_bytes"]
    return {"dataset": one["dataset"], "n": one["n"], "l": one["l"], "stride": one["stride"],
            "template bytes": one["template_bytes"],
            "peak of a solve MiB": None if peak is None else peak / 2**20}  # fmt: skip

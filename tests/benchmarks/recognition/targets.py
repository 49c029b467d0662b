"""What we set out to reach, beside what was measured."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

from tests.benchmarks.results import Record

#: Number of templates at which the ratios to one product are judged, or the largest below it that real frames reach.
_SIZE = 10_000
_RATIO, _REAL_RATIO = 1.3, 3.0


def judge(results: dict[str, Any]) -> list[Record]:
    """Compare every target with its figures; a target without figures was not measured."""
    found = [*_ratios(results["matching"]), *_algorithm2(results["algorithm2"]), *_cvxpy(results["cvxpy"])]
    measured = {one["target"] for one in found}
    missing = [name for name in _NAMES if not any(str(target).startswith(name) for target in measured)]
    return found + [_verdict(name, None, None) for name in missing]


_NAMES = (
    *(f"match over one product, {dataset}" for dataset in ("synthetic", "campus", "real")),
    "times faster than Algorithm 2",
    "times faster than CVXPY",
    "objective above CVXPY's",
)


def _ratios(matching: list[dict[str, Any]]) -> Iterator[Record]:
    for one in _judged(matching):
        allowed = _REAL_RATIO if one["dataset"].startswith("real") else _RATIO
        where = f"{one['dataset']}, n = {one['n']:,}, l = {one['l']}"
        yield _verdict(f"match over one product, {where}", one["ratio"], allowed, worst=one["ratio_worst"])


def _judged(matching: list[dict[str, Any]]) -> Iterable[dict[str, Any]]:
    """Choose the cases at the judged size; of real frames the largest that is not above it."""
    for one in matching:
        if not one["dataset"].startswith("real"):
            if one["n_wanted"] == _SIZE:
                yield one
            continue
        same = [k for k in matching if (k["dataset"], k["l"]) == (one["dataset"], one["l"])]
        if one["n_wanted"] == max((k["n_wanted"] for k in same if k["n_wanted"] <= _SIZE), default=None):
            yield one


def _algorithm2(records: list[dict[str, Any]]) -> Iterator[Record]:
    for one in records:
        if one["n"] == 5000:
            yield _verdict(
                f"times faster than Algorithm 2, n = 5,000, l = {one['l']}", one["times_faster"], 1000.0, True
            )


def _cvxpy(records: list[dict[str, Any]]) -> Iterator[Record]:
    for one in records:
        if one["n"] == 500:
            where = f"n = 500, l = {one['l']}, tolerance {one['tolerance']:.0e}"
            yield _verdict(f"times faster than CVXPY, {where}", one["times_faster"], 500.0, True)
            yield _verdict(f"objective above CVXPY's, {where}", one["relative_difference"], 1e-5)


def _verdict(
    target: str, value: float | None, limit: float | None, at_least: bool = False, worst: float | None = None
) -> Record:
    """Say whether a figure is within its limit; ``worst`` is of all queries, for the reader."""
    if value is None or limit is None:
        return {"target": target, "measured": None, "worst": None, "limit": None, "verdict": "not measured"}
    met = value >= limit if at_least else value <= limit
    sign = "at least" if at_least else "at most"
    return {"target": target, "measured": value, "worst": worst, "limit": f"{sign} {limit:g}",
            "verdict": "met" if met else "not met"}  # fmt: skip

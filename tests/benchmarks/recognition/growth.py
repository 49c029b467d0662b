"""How the time of a match grows with the number of templates."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from tests.benchmarks.results import LeftOutError, Record


def growth(matching: Sequence[dict[str, Any]], dataset: str, smallest: int) -> list[Record]:
    """Fit time = a n^b by least squares in the logarithms, for each length.

    Raises
    ------
    LeftOutError
        Fewer than two sizes of at least ``smallest`` templates were measured.
    """
    cases = [one for one in matching if one["dataset"] == dataset and one["n"] >= smallest]
    if len({one["n"] for one in cases}) < 2:
        raise LeftOutError(f"needs two sizes of {dataset} with at least {smallest:,} templates")
    found: list[Record] = []
    for length in sorted({one["l"] for one in cases}):
        chosen = [one for one in cases if one["l"] == length]
        sizes = [one["n"] for one in chosen]
        times = {
            name: [one[key] for one in chosen] for name, key in (("product", "product_seconds"), ("match", "seconds"))
        }
        found.append({"dataset": dataset, "l": length, "sizes": sizes}
                     | {f"exponent {name}": _exponent(sizes, seconds) for name, seconds in times.items()})  # fmt: skip
    return found


def _exponent(sizes: Sequence[int], seconds: Sequence[float]) -> float:
    return float(np.polyfit(np.log(sizes), np.log(seconds), 1)[0])

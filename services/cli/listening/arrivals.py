"""What ``smal topic hz`` and ``bw`` measure: how regularly the messages of each key come, and how large they are."""

from __future__ import annotations

from array import array
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np

from schemas.codec import printable
from services.kit.tables import number, table

Record = dict[str, Any]
#: Headings of a table for people, with the name of the figure in a record and the factor to its unit.
RATES: Final = {
    "Hz": ("rate_hz", 1.0), "mean ms": ("mean_s", 1e3), "min ms": ("min_s", 1e3), "max ms": ("max_s", 1e3),
    "std dev ms": ("std_s", 1e3),
}  # fmt: skip
SIZES: Final = {
    "kB/s": ("bytes_per_s", 1e-3), "mean kB": ("mean_bytes", 1e-3), "min kB": ("min_bytes", 1e-3),
    "max kB": ("max_bytes", 1e-3),
}  # fmt: skip


@dataclass
class Arrivals:
    """When each message of a key came, seconds, and how many bytes it had."""

    times_s: array[float] = field(default_factory=lambda: array("d"))
    sizes: array[int] = field(default_factory=lambda: array("q"))

    def add(self, size: int, now_s: float) -> None:
        """Note a message."""
        self.times_s.append(now_s)
        self.sizes.append(size)

    def rates(self) -> Record:
        """Return how many came and how regularly, from the first to the last; None for what so few do not tell."""
        gaps_s = np.diff(self.times_s)
        rate_hz = 1.0 / float(gaps_s.mean()) if gaps_s.any() else None
        bytes_per_s = None if rate_hz is None else rate_hz * float(np.mean(self.sizes))
        figures = (gaps_s.mean(), gaps_s.min(), gaps_s.max(), gaps_s.std()) if gaps_s.size else (None,) * 4
        spread = {name: one if one is None else float(one)
                  for name, one in zip(("mean_s", "min_s", "max_s", "std_s"), figures, strict=True)}  # fmt: skip
        return {"messages": len(self.sizes), "rate_hz": rate_hz, "bytes_per_s": bytes_per_s} | spread


def sizes(arrivals: Iterable[Arrivals], elapsed_s: float) -> Record:
    """Return how large the messages of some keys were, and their bandwidth over the whole time of listening.

    So the bandwidths of the keys add up to the total, events among them.
    """
    found = [size for one in arrivals for size in one.sizes]
    return {
        "messages": len(found),
        "bytes": sum(found),
        "bytes_per_s": sum(found) / elapsed_s,
        "mean_bytes": sum(found) / len(found) if found else None,
        "min_bytes": min(found, default=None),
        "max_bytes": max(found, default=None),
    }


def lines(records: Mapping[str, Record], columns: Mapping[str, tuple[str, float]]) -> Iterator[str]:
    """Yield a table: a line of headings, then one line a key."""
    rows = [["key", "messages", *columns]]
    for key, record in records.items():
        figures = [number(record[name], scale) for name, scale in columns.values()]
        rows.append([printable(key), str(record["messages"]), *figures])
    return table(rows)

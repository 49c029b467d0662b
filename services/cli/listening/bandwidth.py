"""What ``smal topic bw`` measures: bandwidth and size of the messages on each key, and in total."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from schemas.codec import printable
from services.kit.tables import table


@dataclass
class Sizes:
    """Payloads on one key, or on several."""

    count: int = 0
    total_bytes: int = 0
    min_bytes: int | None = None
    max_bytes: int | None = None

    def add(self, size: int) -> None:
        """Count one payload of ``size`` bytes."""
        self.include(Sizes(1, size, size, size))

    def include(self, other: Sizes) -> None:
        """Count the payloads of another key as well."""
        if other.min_bytes is None or other.max_bytes is None:
            return
        self.count += other.count
        self.total_bytes += other.total_bytes
        self.min_bytes = other.min_bytes if self.min_bytes is None else min(self.min_bytes, other.min_bytes)
        self.max_bytes = other.max_bytes if self.max_bytes is None else max(self.max_bytes, other.max_bytes)

    @property
    def mean_bytes(self) -> float | None:
        """Mean size; None before the first."""
        return self.total_bytes / self.count if self.count else None

    def record(self, elapsed_s: float) -> dict[str, float | int | None]:
        """Return every figure, for JSON, of ``elapsed_s`` seconds of listening."""
        return {
            "messages": self.count,
            "bytes": self.total_bytes,
            "bytes_per_s": self.total_bytes / elapsed_s,
            "mean_bytes": self.mean_bytes,
            "min_bytes": self.min_bytes,
            "max_bytes": self.max_bytes,
        }


def total(sizes: Mapping[str, Sizes]) -> Sizes:
    """Return the sum over all keys."""
    everything = Sizes()
    for one in sizes.values():
        everything.include(one)
    return everything


def bandwidth_lines(sizes: Mapping[str, Sizes], elapsed_s: float) -> Iterator[str]:
    """Yield the table of ``elapsed_s`` seconds: headings, one line a key, and the total.

    The rate is that of the whole time of listening, so that the keys add up to the total, events among them.
    """
    rows = [["key", "messages", "bandwidth", "mean", "min", "max"]]
    for name, one in [*((printable(key), one) for key, one in sorted(sizes.items())), ("total", total(sizes))]:
        figures = (one.mean_bytes, one.min_bytes, one.max_bytes)
        rows.append([name, str(one.count), f"{human(one.total_bytes / elapsed_s)}/s", *map(human, figures)])
    return table(rows)


def human(size: float | None) -> str:
    """Return a number of bytes with three digits or so and its unit, in powers of 1000; a dash for None."""
    if size is None:
        return "-"
    for unit in ("B", "kB", "MB"):
        # What rounds to 1000 belongs to the next unit.
        if size < 999.5:
            return f"{size:.0f} {unit}" if size >= 99.95 or size == int(size) else f"{size:.1f} {unit}"
        size /= 1000
    return f"{size:.1f} GB"

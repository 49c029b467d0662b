"""What ``smal topic hz`` measures: rate and regularity of the samples on each key."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from schemas.codec import printable
from services.kit.tables import number, table


@dataclass
class Rate:
    """Arrivals on one key; the figures go from the first sample to the last."""

    count: int = 0
    total_bytes: int = 0
    first_s: float = 0.0
    last_s: float = 0.0
    min_s: float | None = None
    max_s: float | None = None
    #: Welford's running sum of squared deviations, and its mean: no list of intervals however long one listens.
    squares: float = 0.0
    running_mean_s: float = 0.0

    def add(self, size: int, now_s: float) -> None:
        """Count one sample of ``size`` bytes that arrived at ``now_s``."""
        if self.count:
            interval_s = now_s - self.last_s
            self.min_s = interval_s if self.min_s is None else min(self.min_s, interval_s)
            self.max_s = interval_s if self.max_s is None else max(self.max_s, interval_s)
            deviation_s = interval_s - self.running_mean_s
            self.running_mean_s += deviation_s / self.count
            self.squares += deviation_s * (interval_s - self.running_mean_s)
        else:
            self.first_s = now_s
        self.last_s = now_s
        self.count += 1
        self.total_bytes += size

    @property
    def rate_hz(self) -> float | None:
        """Samples a second; None before two have come."""
        span_s = self.last_s - self.first_s
        return (self.count - 1) / span_s if span_s > 0 else None

    @property
    def bytes_per_s(self) -> float | None:
        """Bandwidth of the payloads."""
        return None if self.rate_hz is None else self.rate_hz * self.total_bytes / self.count

    @property
    def mean_s(self) -> float | None:
        """Mean interval between two samples."""
        return (self.last_s - self.first_s) / (self.count - 1) if self.count > 1 else None

    @property
    def std_s(self) -> float | None:
        """Standard deviation of the intervals, the jitter."""
        return math.sqrt(self.squares / (self.count - 1)) if self.count > 1 else None

    def record(self) -> dict[str, float | int | None]:
        """Return every figure, for JSON."""
        return {
            "messages": self.count,
            "rate_hz": self.rate_hz,
            "bytes_per_s": self.bytes_per_s,
            "mean_s": self.mean_s,
            "min_s": self.min_s,
            "max_s": self.max_s,
            "std_s": self.std_s,
        }


def rate_lines(rates: Mapping[str, Rate]) -> Iterator[str]:
    """Yield the table of rates: a line of headings, then one line a key."""
    rows = [["key", "messages", "Hz", "mean ms", "min ms", "max ms", "std dev ms"]]
    for key, rate in sorted(rates.items()):
        intervals_s = (rate.mean_s, rate.min_s, rate.max_s, rate.std_s)
        figures = [number(rate.rate_hz), *(number(value, 1e3) for value in intervals_s)]
        rows.append([printable(key), str(rate.count), *figures])
    return table(rows)

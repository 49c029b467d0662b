"""What ``smal topic hz`` measures: rate, bandwidth and regularity of the samples on each key."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Final

from schemas.codec import printable


@dataclass
class Rate:
    """Arrivals on one key; the figures go from the first sample to the last."""

    count: int = 0
    total_bytes: int = 0
    first_s: float = 0.0
    last_s: float = 0.0
    min_s: float | None = None
    max_s: float | None = None

    def add(self, size: int, now_s: float) -> None:
        """Count one sample of ``size`` bytes that arrived at ``now_s``."""
        if self.count:
            interval_s = now_s - self.last_s
            self.min_s = interval_s if self.min_s is None else min(self.min_s, interval_s)
            self.max_s = interval_s if self.max_s is None else max(self.max_s, interval_s)
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

    def record(self) -> dict[str, float | int | None]:
        """Return every figure, for JSON."""
        return {
            "messages": self.count,
            "rate_hz": self.rate_hz,
            "bytes_per_s": self.bytes_per_s,
            "mean_s": self.mean_s,
            "min_s": self.min_s,
            "max_s": self.max_s,
        }


#: Heading, width and text of each column of the table.
_COLUMNS: Final[tuple[tuple[str, int, Callable[[Rate], str]], ...]] = (
    ("messages", 8, lambda rate: str(rate.count)),
    ("Hz", 8, lambda rate: _number(rate.rate_hz, 1)),
    ("kB/s", 9, lambda rate: _number(rate.bytes_per_s, 1e-3)),
    ("mean ms", 8, lambda rate: _number(rate.mean_s, 1e3)),
    ("min ms", 8, lambda rate: _number(rate.min_s, 1e3)),
    ("max ms", 8, lambda rate: _number(rate.max_s, 1e3)),
)


def rate_lines(rates: Mapping[str, Rate]) -> Iterator[str]:
    """Yield the table of rates: a line of headings, then one line a key."""
    rows = {printable(key): rate for key, rate in sorted(rates.items())}
    width = max(map(len, ["key", *rows]))
    yield f"{'key':{width}}  " + " ".join(f"{heading:>{w}}" for heading, w, _ in _COLUMNS)
    for key, rate in rows.items():
        yield f"{key:{width}}  " + " ".join(f"{text(rate):>{w}}" for _, w, text in _COLUMNS)


def _number(value: float | None, scale: float) -> str:
    return "-" if value is None else f"{scale * value:.2f}"

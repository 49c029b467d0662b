"""What processes hold (memory, descriptors, threads), and whether it grows."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from tests.benchmarks.reporting import Record

WARM_UP_SHARE: Final = 0.1  # Of the run, and at least so long: what is allocated once.
WARM_UP_S: Final = 120.0
MOST_GROWTH: Final = 0.05
_PROC: Final = Path("/proc")


@dataclass(frozen=True)
class Sample:
    """What one process held so many seconds after the beginning."""

    t_s: float
    service: str
    pid: int
    rss_bytes: int
    descriptors: int
    threads: int


def sample(t_s: float, service: str, pid: int) -> Sample:
    """Look at a process.

    Raises
    ------
    OSError
        There is none of this id.
    """
    lines = (_PROC / str(pid) / "status").read_text().splitlines()
    fields = {name: value.split() for name, _, value in (line.partition(":") for line in lines)}
    descriptors = sum(1 for _ in (_PROC / str(pid) / "fd").iterdir())
    return Sample(
        t_s, service, pid, 1024 * int(fields["VmRSS"][0]), descriptors, int(fields["Threads"][0])
    )


def warmed_up(samples: Sequence[Any]) -> list[Any]:
    """Return the samples after the warm-up; in a run too short for one, those of the second half."""
    whole_s = max((one.t_s for one in samples), default=0.0)
    warm_s = min(max(WARM_UP_SHARE * whole_s, WARM_UP_S), whole_s / 2.0)
    return [one for one in samples if one.t_s >= warm_s]


def judge(samples: Sequence[Sample]) -> list[Record]:
    """Judge each service by its samples after the warm-up."""
    services = dict.fromkeys(one.service for one in samples)
    return [_judge([one for one in samples if one.service == service]) for service in services]


def _judge(samples: Sequence[Sample]) -> Record:
    warm = warmed_up(samples)
    first, last = line([one.t_s for one in warm], [one.rss_bytes for one in warm])
    descriptors, threads = (
        rise([getattr(one, name) for one in warm]) for name in ("descriptors", "threads")
    )
    restarts = len({one.pid for one in samples}) - 1
    return {
        "service": samples[0].service,
        "rss_mb": warm[-1].rss_bytes / 1e6,
        "growth_percent": 100.0 * (last / first - 1.0),
        "descriptors_rise": descriptors,
        "threads_rise": threads,
        "restarts": restarts,
        "": said(
            memory=last / first - 1.0 >= MOST_GROWTH, descriptors=descriptors > 0, threads=threads > 0,
            restarted=restarts > 0,
        ),
    }  # fmt: skip


def said(**failed: bool) -> str:
    """Name what is not met, if anything."""
    names = [name for name, one in failed.items() if one]
    return f"NOT MET: {', '.join(names)}" if names else "met"


def line(times: Sequence[float], sizes: Sequence[float]) -> tuple[float, float]:
    """Return where a straight line through sizes over time begins and ends."""
    if len(times) < 2:
        return float(sizes[0]), float(sizes[-1])
    slope, at_zero = np.polyfit(times, np.array(sizes, dtype=float), 1)
    return float(at_zero + slope * times[0]), float(at_zero + slope * times[-1])


def rise(counts: Sequence[int]) -> float:
    """Return by how much the median of the last quarter is above that of the first: what comes and goes is no leak."""
    quarter = max(1, len(counts) // 4)
    return float(np.median(counts[-quarter:]) - np.median(counts[:quarter]))

"""What became of an emergency stop in a flood, by the robot's own notes."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

from services.robot.loop import STAND_WITHIN_S

#: Names the file of the robot's notes, in the environment.
NOTES: Final = "BENCH_STOPS"


@dataclass(frozen=True)
class Stop:
    """One emergency stop in a flood.

    Parameters
    ----------
    flood : str
    rate_hz : float
        Messages or calls of the flood in a second, at its sender.
    late_s : float, optional
        From the put of the stop to the robot's standing; None where it was lost.
    """

    flood: str
    rate_hz: float
    late_s: float | None

    @property
    def in_time(self) -> bool:
        """Whether the robot stood as soon as it has to."""
        return self.late_s is not None and self.late_s <= STAND_WITHIN_S


@dataclass(frozen=True)
class Stood:
    """What became of a stop.

    Parameters
    ----------
    latched_s : float
        When the gate took it, monotonic seconds.
    stood_s : float, optional
        When the actuator was told to stand for it; None while no episode runs, where the robot stands anyway.
    """

    latched_s: float
    stood_s: float | None = None

    @property
    def at_s(self) -> float:
        """When it was obeyed, monotonic seconds."""
        return self.latched_s if self.stood_s is None else self.stood_s


def read_notes(path: Path) -> Mapping[int, Stood]:
    """Return what became of each stop so far, by its number; of one that came twice the first counts."""
    stops: dict[int, Stood] = {}
    for stop, what, at_s in _notes(path):
        if what == "latched_s":
            stops.setdefault(stop, Stood(at_s))
        elif stops[stop].stood_s is None:
            stops[stop] = replace(stops[stop], stood_s=at_s)
    return stops


def _notes(path: Path) -> Iterator[tuple[int, str, float]]:
    *whole, _rest = path.read_text().split("\n")  # the last line may be half written
    yield from map(json.loads, whole)

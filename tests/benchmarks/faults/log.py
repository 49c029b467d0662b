"""What an observer of a stack, and a moving base, have seen, as lines of JSON that are only ever appended to."""

from __future__ import annotations

import json
import time
from collections.abc import Iterable
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

from schemas.base import Message
from schemas.command import Command, CommandApplied
from schemas.episode import Episode

#: Fields that are kept besides the header: those that the judgements are about, and none that is big.
_TOLD = ("x_m", "y_m", "heading_rad", "sequence", "atom", "speed", "source", "reason", "answered_tick", "latency_ns",
         "refused", "event", "outcome", "status", "kind")  # fmt: skip
#: Where a message stands among those of its topic and episode: no two have the same place.
Order = tuple[int | str, ...]


@dataclass(frozen=True)
class Entry:
    """One message as it arrived.

    Parameters
    ----------
    t_s : float
        Arrival, monotonic seconds, the same clock in all processes of the machine.
    topic, episode, tick, stamp_ns
        As in the message.
    order : tuple
        Place among the messages of topic and episode.
    told : dict
        Other fields of the message.
    """

    t_s: float
    topic: str
    episode: str
    tick: int
    stamp_ns: int
    order: Order
    told: dict[str, Any] = field(default_factory=dict)

    def line(self) -> str:
        """Return the entry as a line of JSON."""
        return json.dumps(vars(self), separators=(",", ":")) + "\n"


def entry_of(message: Message, t_s: float) -> Entry:
    """Note a message that arrived at ``t_s``."""
    told = {name: value for name in _TOLD if (value := getattr(message, name, None)) is not None}
    order = order_of(message.tick, told if isinstance(message, Command | CommandApplied | Episode) else {})
    return Entry(t_s, message.topic_name, message.episode, message.tick, message.stamp_ns, order, told)


def order_of(tick: int, told: dict[str, Any]) -> Order:
    """Return a message's place, of its fields: several events or commands may belong to one tick."""
    return (tick, *(told[name] for name in ("sequence", "event") if name in told))


def parse(lines: Iterable[str]) -> list[Entry]:
    """Read lines back."""
    return [Entry(**(fields := json.loads(line)) | {"order": tuple(fields["order"])}) for line in lines]


class Tail:
    """Follows a log while it is written."""

    def __init__(self, path: Path) -> None:
        self._file: IO[str] = path.open()
        self._rest = ""

    def read(self) -> list[Entry]:
        """Return the entries that are new; a line that is being written waits for its end."""
        *whole, self._rest = (self._rest + self._file.read()).split("\n")
        return parse(whole)

    def close(self) -> None:
        """Close the file."""
        self._file.close()


@dataclass(frozen=True)
class Step:
    """One step of the moving base.

    Parameters
    ----------
    t_s : float
        When it ended: in the file by the clock that also passes while the machine is suspended, read by the monotonic.
    x_m, y_m, heading_rad : float
        Where.
    speed_m_s : float
        Of the faster wheel, 0 where the base stands.
    atom : str
        What it carried out; ``stop`` as well where its watchdog made it stand.
    ordered_s : float
        When the last order came, by the same clock.
    """

    t_s: float
    x_m: float
    y_m: float
    heading_rad: float
    speed_m_s: float
    atom: str
    ordered_s: float

    def line(self) -> str:
        """Return the step as a line of JSON."""
        return json.dumps(list(vars(self).values())) + "\n"


def boot_ahead_s() -> float:
    """Return how far the clock of robot and base is ahead of the monotonic one: for how long the machine slept."""
    return time.clock_gettime(time.CLOCK_BOOTTIME) - time.monotonic()


def read_steps(path: Path, since_s: float) -> list[Step]:
    """Read what a base has done since then, monotonic seconds; it may be in the middle of a line."""
    ahead_s = boot_ahead_s()
    *whole, _rest = path.read_text().split("\n")
    steps = (Step(t_s - ahead_s, *pose, ordered_s - ahead_s) for t_s, *pose, ordered_s in map(json.loads, whole))
    return [step for step in steps if step.t_s > since_s]


def read_log(path: Path) -> list[Entry]:
    """Read the log so far; whoever writes it may be in the middle of a line, or may have been killed there."""
    with closing(Tail(path)) as log:
        return log.read()

"""What an observer of a stack has seen, as lines of JSON that are only ever appended to."""

from __future__ import annotations

import json
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
    """Follows a log while it is written.

    Parameters
    ----------
    path : Path
    """

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


def read_log(path: Path) -> list[Entry]:
    """Read the log so far; whoever writes it may be in the middle of a line, or may have been killed there."""
    with closing(Tail(path)) as log:
        return log.read()

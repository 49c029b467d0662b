"""Words, and tables of them, that pages and commands share."""

import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import Protocol


def counted(count: int, what: str) -> str:
    """Return "1 drive" or "2 drives"."""
    return f"{count:,} {what}{'s' * (count != 1)}"


class _Run(Protocol):
    """A run, or what is asked for: what of it may be other than it was taught."""

    @property
    def start(self) -> str: ...
    @property
    def kidnap_tick(self) -> int | None: ...
    @property
    def victim(self) -> str: ...
    @property
    def obstacles(self) -> int: ...
    @property
    def people(self) -> int: ...
    @property
    def blocked(self) -> bool: ...


def condition(run: _Run, more: Mapping[str, object] = MappingProxyType({})) -> str:
    """Return what is special about a run, in a few words; ``more`` are others, each with whether it holds."""
    said = dict(more) | {
        "from anywhere": run.start == "anywhere",
        "kidnapped": run.kidnap_tick,
        f"victim {run.victim}": run.victim != "there",
        counted(run.obstacles, "obstacle"): run.obstacles,
        f"{run.people} people": run.people,
        "blocked": run.blocked,
    }
    return ", ".join(name for name, holds in said.items() if holds) or "as taught"


def listed(names: Sequence[str]) -> str:
    """Name ten of them, and say how many more there are."""
    return ", ".join(names[:10]) + (f" and {len(names) - 10} more" if len(names) > 10 else "")


def remark(lines: Iterable[object]) -> None:
    """Say something on standard error, a line each."""
    sys.stderr.writelines(f"smal: {line}\n" for line in lines)


def table(rows: Sequence[Sequence[str]], left: int = 1) -> Iterator[str]:
    """Yield one line a row: the first ``left`` columns begin below each other, the others (numbers) end there."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for row in rows:
        cells = (
            f"{cell:{'<' if column < left else '>'}{width}}"
            for column, (cell, width) in enumerate(zip(row, widths, strict=True))
        )
        yield "  ".join(cells).rstrip()


def number(value: float | None, scale: float = 1.0) -> str:
    """Return ``scale * value`` with two decimals, or a dash for None."""
    return "-" if value is None else f"{scale * value:.2f}"

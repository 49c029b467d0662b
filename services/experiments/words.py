"""Text and tables for pages and commands."""

import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import Any


def counted(count: int, what: str) -> str:
    """Return a number with a noun: "1 drive" or "2 drives"."""
    return f"{count:,} {what}{'s' * (count != 1)}"


def condition(run: Mapping[str, Any], more: Mapping[str, object] = MappingProxyType({})) -> str:
    """Describe how a run (fields of a request or trial) differs from teaching."""
    differences = dict(more) | {
        "from anywhere": run["start"] == "anywhere",
        "turned round": run["start"] == "turned",
        "from where it stood": run["start"] == "here",
        "kidnapped": run["kidnap_tick"],
        f"victim {run['victim']}": run["victim"] != "there",
        counted(run["obstacles"], "obstacle"): run["obstacles"],
        f"{run['people']} people": run["people"],
        "blocked": run["blocked"],
    }
    return ", ".join(name for name, holds in differences.items() if holds) or "as taught"


def listed(names: Sequence[str]) -> str:
    """Return the first ten names and the number of further names."""
    return ", ".join(names[:10]) + (f" and {len(names) - 10} more" if len(names) > 10 else "")


def remark(lines: Iterable[object]) -> None:
    """Write lines to standard error."""
    sys.stderr.writelines(f"smal: {line}\n" for line in lines)


def table(rows: Sequence[Sequence[str]], left: int = 1) -> Iterator[str]:
    """Yield one line per row; the first ``left`` columns are left-aligned, the others right-aligned."""
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

"""Results as JSON, and as tables to read."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

from smal.files.container import replacing

#: What a benchmark found out about one thing; JSON can hold it.
Record = dict[str, object]


class LeftOutError(Exception):
    """A part cannot run here; its text says why, for the JSON and the reader."""


def write_json(path: Path, results: Mapping[str, object]) -> None:
    """Write results so that there is never a half-written file under that name; infinity and NaN are refused."""
    text = json.dumps(results, indent=2, allow_nan=False) + "\n"
    with replacing(path) as file:
        file.write(text.encode())


def table(title: str, rows: Sequence[Mapping[str, object]]) -> str:
    """Lay records with the same keys out in columns, under a title; without rows nothing.

    Numbers stand right, text left.
    """
    if not rows:
        return ""
    names = list(rows[0])
    cells = [[show(row[name]) for name in names] for row in rows]
    widths = [max(len(line[i]) for line in [names, *cells]) for i in range(len(names))]
    right = [not any(isinstance(row[name], str) for row in rows) for name in names]
    lines = [
        "  ".join(
            cell.rjust(w) if r else cell.ljust(w) for cell, w, r in zip(line, widths, right, strict=True)
        ).rstrip()
        for line in [names, *cells]
    ]
    return "\n".join(["", title, *lines, ""])


def show(value: object) -> str:
    """Write a value with as many digits as a reader wants."""
    if value is None:
        return "-"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int):
        return f"{value:,}"
    if isinstance(value, float):
        return f"{value:,.0f}" if abs(value) >= 1000.0 else f"{value:.3g}"
    return str(value)

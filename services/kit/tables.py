"""Tables for a terminal."""

from collections.abc import Iterator, Sequence


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

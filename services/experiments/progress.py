"""How far a command is."""

import json
import os
import sys
from typing import Any

from tqdm import tqdm


def bar_of(items: Any = None, **how: Any) -> "tqdm[Any]":  # noqa: ANN401
    """Return a bar of tqdm's, as wide as the terminal; in one that does not tell its size tqdm alone draws none."""
    told = not sys.stderr.isatty() or all(os.get_terminal_size(sys.stderr.fileno()))
    how |= {"dynamic_ncols": True} if told else {"ncols": 80, "nrows": 24}
    bar: tqdm[Any] = tqdm(items, **how)
    return bar


class Bars:
    """A progress bar for each stage of some work, none in a log file or a pipe; or lines of JSON for a program."""

    def __init__(self, unit: str = "it", *, as_json: bool = False) -> None:
        self._unit = unit
        self._stage = ""
        self._as_json = as_json
        self._percent = -1
        self._bar: tqdm[Any] | None = None

    def __call__(self, stage: str, done: int, total: int) -> None:
        """Show how much of a stage is done; as JSON each percent once."""
        if self._as_json:
            before = (self._stage, self._percent)
            self._stage = stage
            self._percent = 100 * done // max(total, 1)
            if before != (self._stage, self._percent):
                sys.stdout.write(json.dumps({"stage": stage, "done": done, "total": total}) + "\n")
                sys.stdout.flush()
            return
        if self._bar is None or stage != self._stage:
            self.close()
            how = {"desc": stage, "unit": self._unit, "disable": None}
            self._stage = stage
            self._bar = bar_of(**how, initial=done, total=total, smoothing=0)
        self._bar.total = total
        self._bar.update(done - self._bar.n)
        if done == total:
            self._bar.refresh()  # What follows may take long, and tqdm draws ten times a second at most.

    def close(self) -> None:
        """End the last bar."""
        if self._bar is not None:
            self._bar.close()
            self._bar = None

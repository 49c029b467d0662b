"""Progress of a command."""

import json
import os
import sys
from typing import Any

from tqdm import tqdm


def bar_of(items: Any = None, **how: Any) -> "tqdm[Any]":  # noqa: ANN401
    """Return a progress bar of tqdm; its width is set for terminals without a size."""
    told = not sys.stderr.isatty() or all(os.get_terminal_size(sys.stderr.fileno()))
    how |= {"dynamic_ncols": True} if told else {"ncols": 80, "nrows": 24}
    bar: tqdm[Any] = tqdm(items, **how)
    return bar


class Bars:
    """A progress bar for each stage on a terminal; or lines of JSON."""

    def __init__(self, unit: str = "it", *, as_json: bool = False) -> None:
        self._unit = unit
        self._stage = ""
        self._as_json = as_json
        self._percent = -1
        self._bar: tqdm[Any] | None = None

    def __call__(self, stage: str, done: int, total: int) -> None:
        """Update the progress of a stage; as JSON once per percent."""
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
            # The next step can take long, and tqdm draws at most ten times a second.
            self._bar.refresh()

    def close(self) -> None:
        """Close the last bar."""
        if self._bar is not None:
            self._bar.close()
            self._bar = None

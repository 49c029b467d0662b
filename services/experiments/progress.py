"""Progress of a command."""

import json
import os
import sys
import time
from typing import Any, Final

from tqdm import tqdm

LINE_S: Final = 10.0  # Period of the lines of progress in a pipe or a file.


class _Lines:
    """Standard error that is no terminal: a line of progress every `LINE_S`, and the last line."""

    def __init__(self) -> None:
        self._written_s = time.monotonic()
        self._newest = ""
        self._written = ""

    def write(self, text: str) -> None:
        """Write a state of the bar if the last line is old; its last state if there are lines."""
        self._newest = text.strip() or self._newest
        old = time.monotonic() - self._written_s >= LINE_S
        ended = text == "\n" and self._written
        if self._newest != self._written and (old or ended):
            sys.stderr.write(f"{self._newest}\n")
            sys.stderr.flush()
            self._written = self._newest
            self._written_s = time.monotonic()

    def flush(self) -> None:
        """Do nothing; every line is flushed."""


def bar_of(items: Any = None, **how: Any) -> "tqdm[Any]":  # noqa: ANN401
    """Return a progress bar of tqdm, or lines of progress if standard error is no terminal."""
    if not sys.stderr.isatty():
        how |= {"file": _Lines(), "ncols": 0}
    elif all(os.get_terminal_size(sys.stderr.fileno())):
        how |= {"dynamic_ncols": True}
    else:
        how |= {"ncols": 80, "nrows": 24}  # A terminal without a size.
    bar: tqdm[Any] = tqdm(items, **how)
    return bar


class Bars:
    """A progress bar for each stage; or lines of JSON.

    A stage begins at the end of the stage before, so its first item already gives an estimate.
    ``finished`` items of an earlier command do not count.
    """

    def __init__(self, unit: str = "it", *, as_json: bool = False, finished: int = 0) -> None:
        self._unit = unit
        self._finished = finished
        self._began_s = time.time()
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
            how = {"desc": stage, "unit": self._unit}
            self._stage = stage
            self._bar = bar_of(**how, initial=self._finished, total=total, smoothing=0)
            self._bar.start_t = self._began_s
        self._bar.total = total
        self._bar.update(done - self._bar.n)
        if done == total:
            # The next step can take long, and tqdm draws at most ten times a second.
            self._bar.refresh()
        self._began_s = time.time()

    def close(self) -> None:
        """Close the last bar."""
        if self._bar is not None:
            self._bar.close()
            self._bar = None

"""How far a command is, on a terminal."""

from typing import Any

from tqdm import tqdm


class Bars:
    """A progress bar for each stage of some work; none in a log file or a pipe."""

    def __init__(self, unit: str = "it") -> None:
        self._unit, self._stage = unit, ""
        self._bar: tqdm[Any] | None = None

    def __call__(self, stage: str, done: int, total: int) -> None:
        """Show how much of a stage is done."""
        if self._bar is None or stage != self._stage:
            self.close()
            self._stage, self._bar = stage, tqdm(desc=stage, unit=self._unit, dynamic_ncols=True, disable=None)
        self._bar.total = total
        self._bar.update(done - self._bar.n)

    def close(self) -> None:
        """End the last bar."""
        if self._bar is not None:
            self._bar.close()
            self._bar = None

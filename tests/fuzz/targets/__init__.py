"""One module a decoder: ``seeds``, ``run``, and ``mutate``, which knows the format.

``run`` returns whether the input was accepted, or raises where the decoder broke its promise: that any bytes give
either a usable value or the documented exception with one clear line, within bounded time and memory.
"""

from __future__ import annotations

import importlib
import random
from pathlib import Path
from typing import Final, Protocol, cast

NAMES: Final = (
    "messages", "rpc", "samples", "recording", "recovery", "repair", "image", "model", "world", "world_file", "names",
    "tub", "image_table", "bag", "dataset",
)  # fmt: skip
LONGEST_INPUT: Final = 100_000
CRASHERS: Final = Path(__file__).resolve().parents[1] / "crashers"
_LONGEST_LINE: Final = 700


class Target(Protocol):
    """What each module here has."""

    def seeds(self) -> list[bytes]:
        """Return small and different inputs, the first of them valid."""

    def run(self, data: bytes) -> bool:
        """Decode an input and say whether it was accepted; raise where the decoder does what it must not."""

    def mutate(self, data: bytes, rng: random.Random) -> bytes | None:
        """Change an input as only one who knows the format can; None to have its bytes changed instead."""


def load(name: str) -> Target:
    """Import a target; what it decodes with is imported only then, so that the fuzzer can watch it."""
    return cast("Target", importlib.import_module(f"{__name__}.{name}"))


def crashers_of(name: str, folder: Path = CRASHERS) -> list[Path]:
    """Return the kept inputs that once broke a decoder."""
    return sorted(path for path in (folder / name).glob("*") if path.is_file())


def check_line(error: BaseException | str) -> None:
    """Raise unless a text is one line that fits a log and moves no terminal."""
    text = str(error)
    if not text or len(text) > _LONGEST_LINE or not text.isprintable():
        raise AssertionError(f"not one clear line: {text[:2000]!r}") from (
            error if isinstance(error, BaseException) else None
        )

"""Freed memory goes back to the system."""

from typing import Final

import psutil

from services.kit.memory import give_back

_BLOCK: Final = 100_000  # Bytes; smaller than what the system gives singly, and takes back at once.
_BLOCKS: Final = 500


def _held() -> int:
    return int(psutil.Process().memory_info().rss)


def test_freed_memory_is_given_back() -> None:
    blocks = [bytes([1]) * _BLOCK for _ in range(_BLOCKS)]
    pins = blocks[::50]
    before = _held()
    blocks.clear()
    give_back()
    assert before - _held() > 0.8 * _BLOCK * (_BLOCKS - len(pins))

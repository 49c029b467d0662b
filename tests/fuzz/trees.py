"""Changes in plain data (maps, lists, scalars), as msgpack and JSON carry it."""

from __future__ import annotations

import json
import random
from typing import Any

#: What decoders trip over: ends of ranges, other types, texts that move a terminal, emptiness, size.
ODD: list[Any] = [
    None, True, False, 0, 1, -1, 2, 255, 256, 10_000_000, 10_000_001, 2**31, 2**32, 2**53, 2**63 - 1, 2**63, 2**64 - 1,
    -(2**63), 0.0, -0.0, 0.5, 1e-320, 1e308, float("nan"), float("inf"), -float("inf"), "", "e", "x" * 5000, "a\nb",
    "\x1b[2J", "\u202e", "\x00", "1", "nan", "forward", "é" * 300, b"", b"\xff" * 9, [], [0], [[]], {}, {"": 0},
    [1.5] * 70, ["x"] * 1100, {str(number): number for number in range(70)},
]  # fmt: skip


def changed(tree: Any, rng: random.Random) -> Any:
    """Return plain data with one to three places changed."""
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        tree = _changed_once(tree, rng)
    return tree


def _changed_once(tree: Any, rng: random.Random) -> Any:
    if isinstance(tree, dict | list | tuple) and tree and rng.random() < 0.8:
        return _changed_map(dict(tree), rng) if isinstance(tree, dict) else _changed_list(list(tree), rng)
    return _changed_leaf(tree, rng)


def _changed_map(tree: dict[Any, Any], rng: random.Random) -> dict[Any, Any]:
    key = rng.choice(list(tree))
    match rng.randrange(12):
        case 0:
            del tree[key]
        case 1:
            tree[rng.choice(["", "x\n", "robot", "data", "y" * 300])] = rng.choice(ODD)
        case 2:
            tree[rng.choice(list(tree))] = tree[key]
        case _:
            tree[key] = _changed_once(tree[key], rng)
    return tree


def _changed_list(tree: list[Any], rng: random.Random) -> list[Any]:
    at = rng.randrange(len(tree))
    match rng.randrange(8):
        case 0:
            del tree[at]
        case 1:
            tree.insert(at, tree[rng.randrange(len(tree))])
        case 2:
            tree = tree * rng.choice((2, 10, 80))
        case _:
            tree[at] = _changed_once(tree[at], rng)
    return tree[:2000]


def _changed_leaf(leaf: Any, rng: random.Random) -> Any:
    choice = rng.random()
    if isinstance(leaf, int | float) and choice < 0.5:
        return rng.choice([leaf + 1, leaf - 1, -leaf, leaf * 1000, float(leaf), str(leaf), [leaf]])
    if isinstance(leaf, str | bytes) and leaf and choice < 0.5:
        at = rng.randrange(len(leaf))
        return rng.choice([leaf[:at], leaf[at:], leaf + leaf, leaf[:at] + leaf[at + 1 :]])
    return rng.choice(ODD)


def changed_json(text: bytes, rng: random.Random) -> bytes | None:
    """Change a JSON document; None where it is none."""
    try:
        tree = changed(json.loads(text), rng)
        return json.dumps(tree, default=repr).encode()
    except (ValueError, RecursionError, OverflowError):
        return None

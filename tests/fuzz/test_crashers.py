"""Inputs that once broke a decoder, valid ones, and changes in these: none breaks it, none costs much.

Needs no fuzzer: the format-aware changes that the fuzzer makes are drawn here with fixed seeds.
"""

from __future__ import annotations

import json
import random
import time
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import numpy as np
import pytest

from tests.fuzz.targets import CRASHERS, LONGEST_INPUT, NAMES, crashers_of, load, model

KEPT: Final = [(name, path) for name in NAMES for path in crashers_of(name)]
MOST_SECONDS: Final = 3.0
MOST_BYTES: Final = 64 * 1024 * 1024
CHANGES: Final = 100


def cheaply(run: Callable[[bytes], bool], data: bytes) -> bool:
    tracemalloc.start()
    begin_s = time.process_time()
    try:
        accepted = run(data)
        _, peak_bytes = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert time.process_time() - begin_s < MOST_SECONDS
    assert peak_bytes < MOST_BYTES
    return accepted


def test_no_crasher_is_forgotten() -> None:
    assert {folder.name for folder in CRASHERS.iterdir()} <= set(NAMES)
    assert KEPT


@pytest.mark.parametrize(("name", "path"), KEPT, ids=[f"{name}-{path.name}" for name, path in KEPT])
def test_what_once_broke_a_decoder_breaks_none(name: str, path: Path) -> None:
    cheaply(load(name).run, path.read_bytes())


@pytest.mark.parametrize("name", NAMES)
def test_seeds_are_decoded(name: str) -> None:
    target = load(name)
    accepted = [cheaply(target.run, data) for data in target.seeds()]
    assert accepted[0]
    assert all(len(data) < LONGEST_INPUT for data in target.seeds())


@pytest.mark.parametrize("name", NAMES)
def test_changed_seeds_are_decoded_or_refused(name: str) -> None:
    target, rng = load(name), random.Random(name)  # noqa: S311
    seeds, changed = target.seeds(), 0
    for number in range(CHANGES):
        data = target.mutate(seeds[number % len(seeds)], rng)
        if data is not None:
            changed += 1
            target.run(data)
    assert changed > CHANGES / 4


@pytest.mark.parametrize(
    "changes",
    [
        {"sequence_length": 0},
        {"sequence_length": -1},
        {"sequence_length": [1], "states": 10**9},
        {"sequence_length": "ab", "states": 10**9},
        {"states": 10**30},
        {"frames": [2**70]},
        {"frames": []},
        {"frames": [[2]]},
        {"lambda1": "small"},
        {"gamma": None},
        {"modalities": ["\x1b[2J"]},
    ],
    ids=lambda changes: json.dumps(changes)[:40],
)
def test_a_model_of_the_paper_whose_header_says_nonsense_is_refused(changes: dict[str, Any]) -> None:
    def change(meta: dict[str, Any]) -> dict[str, Any]:
        return meta | changes

    assert not cheaply(model.run, model.with_meta(model.seeds()[0], change))


@pytest.mark.parametrize(
    "changes",
    [
        {"kappa": -1.0},
        {"kappa": None},
        {"kappa": "x\n" * 3000},
        {"aside": [1.0]},
        {"aside": True},
        {"correlation_length": 10**400},
        {"outlier_cosine": None},
        {"outlier_cosine": "high"},
        {"alike_cosine": None},
        {"odometry": 2},
        {"odometry": "no"},
        {"colour": "red"},
        {"views": 3},
    ],
    ids=lambda changes: json.dumps(changes)[:40],
)
def test_a_map_whose_numbers_say_nonsense_is_refused(changes: dict[str, Any]) -> None:
    def change(meta: dict[str, Any]) -> dict[str, Any]:
        return meta | {"map": meta["map"] | changes}

    assert not cheaply(model.run, model.with_meta(model.seeds()[-1], change))


@pytest.mark.parametrize("instead", [{}, [], "map", 1, True, {"kappa": 1.0}], ids=json.dumps)
def test_a_map_that_is_none_is_refused(instead: object) -> None:
    assert not cheaply(model.run, model.with_meta(model.seeds()[-1], lambda meta: meta | {"map": instead}))


@pytest.mark.parametrize(
    ("name", "array"),
    [
        ("poses", np.zeros((2, 2))),
        ("poses", np.full((2, 3), np.nan)),
        ("poses", np.zeros(())),
        ("drives", np.array([1, 0], np.int32)),
        ("drives", np.array([0.0, 0.0])),
        ("keyframes", np.array([0, 2], np.int32)),
        ("keyframes", np.array([1, 0], np.int32)),
        ("keyframes", np.array([0, -1], np.int32)),
        ("keyframes", np.array([], np.int32)),
        ("keyframes", np.array([0.0, 1.0])),
        ("keyframes", np.array([[0], [1]], np.int32)),
        ("basis", np.ones((5, 1), np.float32)),
        ("basis", np.ones(3, np.float32)),
        ("views", np.full((2, 3, 17, 1), np.inf, np.float32)),
        ("views", np.ones((2, 3, 16, 1), np.float32)),
        ("movements", np.full((5, 2), np.nan)),
        ("scene", np.ones(2)),
        ("mean", np.zeros(3, np.float32)),
        ("mean", np.full(128, np.nan, np.float32)),
        ("more", np.ones(2)),
    ],
    ids=lambda value: value if isinstance(value, str) else f"{value.dtype}{value.shape}",
)
def test_a_map_whose_arrays_do_not_fit_is_refused(name: str, array: np.ndarray) -> None:
    def change(arrays: dict[str, np.ndarray]) -> None:
        arrays[name] = array

    assert not cheaply(model.run, model.with_arrays(model.seeds()[-1], change))


@pytest.mark.parametrize("name", ["mean", "poses", "keyframes", "views", "scene"])
def test_a_map_without_an_array_is_refused(name: str) -> None:
    def change(arrays: dict[str, np.ndarray]) -> None:
        del arrays[name]

    assert not cheaply(model.run, model.with_arrays(model.seeds()[-1], change))

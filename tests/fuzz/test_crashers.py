"""Inputs that once broke a decoder, valid inputs, and changed ones: none breaks it or costs much."""

import re
import time
import tracemalloc
from functools import cache
from pathlib import Path
from typing import Any, Final

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.fuzz import inputs
from tests.fuzz.targets import CRASHERS, LONGEST_INPUT, TARGETS, crashers_of

KEPT: Final = [(name, path) for name in TARGETS for path in crashers_of(name)]
MOST_SECONDS: Final = 3.0
MOST_BYTES: Final = 64 * 1024 * 1024
#: A value of JSON, XML or CSV.
VALUE: Final = re.compile(rb'"[^"\n]*"|(?<=,)[^,\n"]+|-?\d+(?:\.\d+)?|\b(?:true|false|null)\b')
#: What decoders trip over: ends of ranges, other types, texts that move a terminal, emptiness, size.
ODD: Final = [
    b"null", b"true", b"0", b"-1", b"0.5", b"1e308", b"NaN", b"-Infinity", b"1" * 400, str(2**63).encode(), b"", b"[]",
    b"{}", b"[[[]]]", b'""', b'"nan"', b'"\x1b[2J"', '"\u202e٣"'.encode(), b'"' + b"x" * 5000 + b'"', b'"a\\nb"',
]  # fmt: skip
ODD_VALUES: Final = [None, True, 0, -1, 2, 10**30, 10**400, -0.5, 1e308, "", "no", "x\n" * 3000, "\x1b[2J", [], [1.0],
                     [[2]], [2**70], {}, {"x\n" * 3000: 1}]  # fmt: skip


@cache
def seeds_of(name: str) -> list[bytes]:
    """Return the seeds of a decoder, which take longer to make than to decode."""
    return TARGETS[name].seeds()


def cheaply(name: str, data: bytes) -> bool:
    tracemalloc.start()
    begin_s = time.process_time()
    try:
        accepted = TARGETS[name].run(data)
        _, peak_bytes = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert time.process_time() - begin_s < MOST_SECONDS
    assert peak_bytes < MOST_BYTES
    return accepted


def test_no_crasher_is_forgotten() -> None:
    assert {folder.name for folder in CRASHERS.iterdir()} <= set(TARGETS)


@pytest.mark.parametrize(("name", "path"), KEPT, ids=[f"{name}-{path.name}" for name, path in KEPT])
def test_decoder_survives_inputs_that_once_broke_it(name: str, path: Path) -> None:
    cheaply(name, path.read_bytes())


@pytest.mark.parametrize("name", TARGETS)
def test_seeds_are_decoded(name: str) -> None:
    seeds = seeds_of(name)
    accepted = [cheaply(name, data) for data in seeds]
    assert accepted[0]
    assert max(map(len, seeds)) < LONGEST_INPUT


@st.composite
def changed(draw: st.DrawFn, seeds: list[bytes]) -> bytes:
    """Change values of a text, or bytes, at up to three places."""
    data = draw(st.sampled_from(seeds))
    values = list(VALUE.finditer(data))
    for at in range(draw(st.integers(1, 3))):
        if values and at == 0 and draw(st.booleans()):
            begin, end = draw(st.sampled_from(values)).span()
            instead = draw(st.sampled_from(ODD))
        else:
            begin = draw(st.integers(0, len(data)))
            instead = draw(st.binary(max_size=8))
            end = begin + draw(st.sampled_from([len(instead), 0, 100]))
        data = data[:begin] + instead + data[end:]
    return data


@pytest.mark.parametrize("name", TARGETS)
@settings(max_examples=25, suppress_health_check=list(HealthCheck))
@given(data=st.data())
def test_changed_seeds_are_decoded_or_refused(name: str, data: st.DataObject) -> None:
    TARGETS[name].run(data.draw(changed(seeds_of(name))))


@settings(max_examples=30)
@given(data=st.data(), scheme=st.sampled_from([0, 1]), value=st.sampled_from(ODD_VALUES))
def test_model_is_refused_or_usable_when_its_header_is_nonsense(
    data: st.DataObject, scheme: int, value: object
) -> None:

    def change(meta: dict[str, Any], _arrays: dict[str, np.ndarray]) -> None:
        fields = meta["map"] if scheme and data.draw(st.booleans()) else meta
        fields[data.draw(st.sampled_from(sorted(fields)))] = value

    cheaply("model", inputs.with_parts(seeds_of("model")[scheme], change))


@pytest.mark.parametrize(
    ("name", "array"),
    [
        ("poses", np.zeros((2, 2))),
        ("poses", np.full((2, 3), np.nan)),
        ("drives", np.array([1, 0], np.int32)),
        ("drives", np.array([0.0, 0.0])),
        ("keyframes", np.array([0, 2], np.int32)),
        ("keyframes", np.array([1, 0], np.int32)),
        ("keyframes", np.array([0, -1], np.int32)),
        ("keyframes", np.array([], np.int32)),
        ("basis", np.ones((5, 1), np.float32)),
        ("views", np.ones((2, 3, 17, 1), np.float32)),
        ("views", np.ones((2, 3, 16, 1), np.int8)),
        ("movements", np.full((5, 2), np.nan)),
        ("mean", np.full(128, np.nan, np.float32)),
        ("more", np.ones(2)),
        ("mean", None),
        ("views", None),
    ],
    ids=lambda value: (
        f"{value.dtype}{value.shape}" if isinstance(value, np.ndarray) else str(value)
    ),
)
def test_map_is_refused_when_its_arrays_do_not_fit(name: str, array: np.ndarray | None) -> None:
    def change(_meta: dict[str, Any], arrays: dict[str, np.ndarray]) -> None:
        arrays.pop(name, None)
        if array is not None:
            arrays[name] = array

    assert not cheaply("model", inputs.with_parts(seeds_of("model")[-1], change))

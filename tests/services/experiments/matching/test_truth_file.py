"""What people write about two image folders is read as it was meant, or refused in one line."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from services.experiments.matching.truth_file import read_truth
from services.kit.errors import UsageError

HEADER = "query,reference_first,reference_last\n"


@given(st.integers(0, 2**32 - 1), st.integers(1, 20), st.integers(1, 20))
@settings(max_examples=50, deadline=None)
def test_truth_file_is_unchanged_when_read_back(
    tmp_path_factory: pytest.TempPathFactory, seed: int, queries: int, references: int
) -> None:
    """The right references are kept as sets beside the file."""
    rng = np.random.default_rng(seed)
    rows = []
    right = {}
    for query in rng.permutation(queries)[: rng.integers(1, queries + 1)].tolist():
        first, last = sorted(rng.integers(0, references, 2).tolist())
        nothing = rng.random() < 0.3
        rows.append(f"{query},," if nothing else f"{query}, {first} ,{last}")
        right[query] = set() if nothing else set(range(first, last + 1))
        if not nothing and rng.random() < 0.3:
            rows.append(f"{query},{last},{last}")
    assume(any(right.values()))
    path = tmp_path_factory.mktemp("truth") / "truth.csv"
    path.write_text(HEADER + "\n".join(rows), encoding="utf-8")
    truth = read_truth(path, queries, references)
    assert truth.judged.tolist() == [query in right for query in range(queries)]
    found: dict[int, set[int]] = {}
    for query, first, last in zip(
        truth.query.tolist(), truth.first.tolist(), truth.last.tolist(), strict=True
    ):
        found.setdefault(query, set()).update(range(first, last + 1))
    assert found == {query: some for query, some in right.items() if some}


def test_files_of_spreadsheets_are_read(tmp_path: Path) -> None:
    path = tmp_path / "truth.csv"
    content = '\ufeffreference_last, note,"query",reference_first\r\n3,"a, b",0,2\r\n\r\n,,1,\r\n'
    path.write_bytes(content.encode("utf-8"))
    truth = read_truth(path, 3, 4)
    assert (truth.query.tolist(), truth.first.tolist(), truth.last.tolist()) == ([0], [2], [3])
    assert truth.judged.tolist() == [True, True, False]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "line 1: needs the column query once; the columns are ''"),
        ("query,reference_first\n0,1\n", "line 1: needs the column reference_last once"),
        ("0,1,2\n", "line 1: needs the column query once; the columns are '0,1,2'"),
        ("query,query,reference_first,reference_last\n", "line 1: needs the column query once"),
        (HEADER + "0,,\n", "no query has a reference; nothing to find"),
        (HEADER + "0,1,2\n1,x,2\n", "line 3: reference_first must be a frame's .* got 'x'"),
        (HEADER + "-1,1,2\n", "line 2: query must be a frame's number, counted .* got '-1'"),
        (HEADER + "1_0,1,2\n", "line 2: query must be a frame's number"),
        (HEADER + "٣,1,2\n", "line 2: query must be a frame's number"),
        (HEADER + "0,\x1b[2J,2\n", r"line 2: reference_first must be .* got '\?\[2J'"),
        (HEADER + "0,3,2\n", "line 2: reference_first 3 is after reference_last 2"),
        (HEADER + "0,1,5\n", "line 2: reference_last 5 is too large: the traverse has 5 frames"),
        (HEADER + "\n4,1,2\n", "line 3: query 4 is too large: the traverse has 4 frames"),
        (HEADER + "0,1,2\n1,1,2\n0,,\n", "line 4: query 0 has several rows"),
        (HEADER + "0,1\n", "line 2: reference_last must be a frame's number, .* got ''"),
        (HEADER + "0,1,2,3\n", "line 2: has more values than columns"),
        (HEADER + '0,"1,2\n1,2,2\n', "line 3: unexpected end of data"),
        (HEADER + "0,1,2\n1,\udcff,2\n", "not UTF-8"),
    ],
)
def test_a_bad_file_is_refused_in_one_line(tmp_path: Path, content: str, message: str) -> None:
    path = tmp_path / "truth.csv"
    path.write_bytes(content.encode("utf-8", "surrogateescape"))
    with pytest.raises(UsageError, match=message) as caught:
        read_truth(path, 4, 5)
    assert str(caught.value).startswith(f"--truth {path}: ")
    assert str(caught.value).isprintable()


def test_a_file_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"no\.csv: cannot be read: No such file"):
        read_truth(tmp_path / "no.csv", 1, 1)
    with pytest.raises(UsageError, match="cannot be read: Is a directory"):
        read_truth(tmp_path, 1, 1)

"""Which answers are right, from poses and from files."""

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from smal.evaluation.ground_truth import IntervalTruth, PoseTruth, judge
from smal.evaluation.truth_file import TruthFileError, read_truth
from smal.place_recognition import Matches

HEADER = "query,reference_first,reference_last\n"


@given(st.integers(0, 2**32 - 1), st.integers(1, 20), st.integers(1, 20))
@settings(max_examples=50, deadline=None)
def test_a_file_says_what_was_written(
    tmp_path_factory: pytest.TempPathFactory, seed: int, queries: int, references: int
) -> None:
    """Against sets of right references that are kept beside the file."""
    rng = np.random.default_rng(seed)
    rows, right = [], {}
    for query in rng.permutation(queries)[: rng.integers(1, queries + 1)].tolist():
        first, last = sorted(rng.integers(0, references, 2).tolist())
        nothing = rng.random() < 0.3
        rows.append(f"{query},," if nothing else f"{query}, {first} ,{last}")
        right[query] = set() if nothing else set(range(first, last + 1))
    path = tmp_path_factory.mktemp("truth") / "truth.csv"
    path.write_text(HEADER + "\n".join(rows), encoding="utf-8")
    truth = read_truth(path, queries, references)
    assert truth.judged.tolist() == [query in right for query in range(queries)]
    assert truth.findable.tolist() == [bool(right.get(query)) for query in range(queries)]
    grid = truth.right(np.arange(queries)[:, np.newaxis], np.arange(references))
    assert grid.tolist() == [[j in right.get(query, ()) for j in range(references)] for query in range(queries)]


def test_files_of_spreadsheets_are_read(tmp_path: Path) -> None:
    """A byte order mark, lines that end with CR LF, other columns, another order, quotes and empty lines."""
    path = tmp_path / "truth.csv"
    content = '\ufeffreference_last, note,"query",reference_first\r\n3,"a, b",0,2\r\n\r\n,,1,\r\n'
    path.write_bytes(content.encode("utf-8"))
    truth = read_truth(path, 3, 4)
    assert truth.first.tolist() == [2, -1, -1]
    assert truth.last.tolist() == [3, -1, -1]
    assert truth.judged.tolist() == [True, True, False]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "the file is empty"),
        (HEADER.encode(), "there is no row after the columns' names"),
        (b"query,reference_first\n0,1\n", "line 1: needs the column reference_last once; the columns are 'query,ref"),
        (b"0,1,2\n", "line 1: needs the column query once; the columns are '0,1,2'"),
        (b"query,query,reference_first,reference_last\n", "line 1: needs the column query once"),
        (HEADER.encode() + b"0,1,2\n1,x,2\n", "line 3: reference_first must be a frame's number, .* got 'x'"),
        (HEADER.encode() + b"-1,1,2\n", "line 2: query must be a frame's number, counted from 0, got '-1'"),
        (HEADER.encode() + b"1_0,1,2\n", "line 2: query must be a frame's number"),
        (HEADER.encode() + "٣,1,2\n".encode(), "line 2: query must be a frame's number"),
        (HEADER.encode() + b"0,\x1b[2J,2\n", r"line 2: reference_first must be .* got '\?\[2J'"),
        (HEADER.encode() + b"0,3,2\n", "line 2: reference_first 3 is after reference_last 2"),
        (HEADER.encode() + b"0,1,5\n", "line 2: reference_last 5 is beyond the traverse: it has 5 frames"),
        (HEADER.encode() + b"\n4,1,2\n", "line 3: query 4 is beyond the traverse: it has 4 frames"),
        (HEADER.encode() + b"0,1,2\n1,1,2\n0,,\n", "line 4: query 0 has a row already"),
        (HEADER.encode() + b"0,1\n", "line 2: reference_last must be a frame's number, counted from 0, got ''"),
        (HEADER.encode() + b"0,1,2,3\n", "line 2: has more values than columns"),
        (HEADER.encode() + b'0,"1,2\n1,2,2\n', "line 3: not CSV: "),
        (HEADER.encode() + b"0,1,2\n1,\xff,2\n", "line 3: not UTF-8"),
    ],
)
def test_a_bad_file_is_refused_in_one_line(tmp_path: Path, content: bytes, message: str) -> None:
    path = tmp_path / "truth.csv"
    path.write_bytes(content)
    with pytest.raises(TruthFileError, match=message) as caught:
        read_truth(path, 4, 5)
    assert str(caught.value).startswith(f"{path}: ")
    assert str(caught.value).isprintable()


def test_a_file_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(TruthFileError, match=r"no\.csv: cannot be read: No such file"):
        read_truth(tmp_path / "no.csv", 1, 1)
    with pytest.raises(TruthFileError, match="cannot be read: Is a directory"):
        read_truth(tmp_path, 1, 1)


@given(st.integers(0, 2**32 - 1), st.floats(0.1, 3.0), st.floats(1.0, 179.0))
@settings(max_examples=50, deadline=None)
def test_poses_are_near_and_look_the_same_way(seed: int, distance_m: float, angle_deg: float) -> None:
    """Against the angle between the two directions as vectors; headings come with any number of turns."""
    rng = np.random.default_rng(seed)
    references, queries = (np.column_stack([rng.uniform(0, 4, (n, 2)), rng.uniform(-20, 20, n)]) for n in (30, 300))
    truth = PoseTruth(references, queries, distance_m, angle_deg)
    grid = truth.right(np.arange(300)[:, np.newaxis], np.arange(30))
    assert truth.judged.all()
    assert truth.findable.tolist() == grid.any(axis=1).tolist()
    for i in range(0, 300, 30):
        for j in range(30):
            (x, y, a), (u, v, b) = queries[i], references[j]
            cos = math.cos(a) * math.cos(b) + math.sin(a) * math.sin(b)
            apart_deg = math.degrees(math.acos(max(-1.0, min(1.0, cos))))
            assert grid[i, j] == (math.dist((x, y), (u, v)) <= distance_m and apart_deg <= angle_deg)


def test_judging_takes_what_is_right_and_nothing_else() -> None:
    """Right; wrong; not judged; nothing to find; no answer."""
    truth = IntervalTruth(np.array([2, 2, -1, -1, 0]), np.array([4, 4, -1, -1, 9]), np.array([1, 1, 0, 1, 1], bool))
    matches = Matches(np.array([4, 5, 3, 3, -1]), np.array([5.0, 4.0, 3.0, 2.0, 0.0]))
    judgement = judge(matches, truth)
    assert judgement.right.tolist() == [True, False, False, False, False]
    assert judgement.answered.tolist() == [True, True, True, True, False]
    assert judgement.findable.tolist() == [True, True, False, False, True]
    with pytest.raises(ValueError, match="the truth is about 5 queries, the matches about 2"):
        judge(Matches.none(2), truth)

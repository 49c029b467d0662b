"""The words of the report, against numbers that are known."""

from __future__ import annotations

from pathlib import Path

import pytest

from services.experiments.evaluation.plan import Trial
from services.experiments.evaluation.report.comparisons import compare_recognition, compare_searches, long_sequences
from services.experiments.evaluation.report.summary import Success, recognized, successes
from tests.services.experiments.evaluation.evaluated import SMALL, finished

(WORLD,) = SMALL.worlds


def test_words_follow_the_numbers(tmp_path: Path) -> None:
    planned, store = finished(tmp_path)
    recognition = compare_recognition("yard", recognized(WORLD, planned, store.findings))
    verdicts = {one.text.split(" of ")[2].split(",")[0] + one.text.split(":")[0]: one.verdict for one in recognition}
    assert verdicts["single image (l = 1)recognition, occluded"] == "ahead"
    # All are judged on frames at which every method has a whole window: with a clear view nothing tells them apart.
    assert verdicts["single image (l = 1)recognition, clean"] == "open"
    searches = compare_searches("yard", successes(WORLD, planned, store.findings))
    said = {one.text: one.verdict for one in searches}
    (against,) = [text for text in said if "occluded" in text]
    assert said[against] == "ahead"
    assert against.startswith(
        "searches after 1 drive, occluded: 8 of 8 found by SMAL against 0 of 8 by teach and repeat"
    )
    assert "SMAL is ahead (p = 0.0078)" in against
    assert all(verdict == "open" for text, verdict in said.items() if "as taught" in text)
    assert sum("after 2 drives, as taught" in text for text in said) == 5


def test_a_few_wins_are_no_proof() -> None:
    def counted(controller: str, found: int) -> Success:
        ends = {seed: {"outcome": "found" if seed < found else "timeout"} for seed in range(8)}
        return Success(Trial(controller, 1, 8), ends)

    (close,) = compare_searches("yard", [counted("smal", 8), counted("nearest-1", 4)])
    assert close.verdict == "open"
    (lost,) = compare_searches("yard", [counted("smal", 1), counted("nearest-1", 8)])
    assert lost.verdict == "behind"
    assert "SMAL is behind" in lost.text


def lengths(**found: int) -> list[Success]:
    """Return searches of the paper's scheme with 10 runs for each length lN."""
    return [
        Success(
            Trial("paper", 2, 10, int(name[1:]), "poor"),
            {seed: {"outcome": "found" if seed < count else "timeout"} for seed in range(10)},
        )
        for name, count in found.items()
    ]


@pytest.mark.parametrize(
    ("found", "end"),
    [
        (lengths(l1=0, l5=0, l20=0), "no length finds the victim"),
        (lengths(l1=8, l5=10, l20=10, l40=10), "long sequences are as good as the best short one"),
        (lengths(l5=8, l20=10, l40=9), "long sequences are as good as the best short one"),
        (lengths(l5=10, l20=10, l40=9), "long sequences find it less often than l = 5, which may be chance"),
        (lengths(l5=10, l20=10, l40=0), "l = 40 lose against l = 5"),
        (lengths(l1=9, l5=10, l20=2, l40=0), "l = 20, 40 lose against l = 5"),
    ],
)
def test_long_sequences_are_compared_with_the_best_short_one(found: list[Success], end: str) -> None:
    (said,) = long_sequences("yard", found)
    assert said.text.endswith(f"; {end}")
    assert said.verdict == "counts"

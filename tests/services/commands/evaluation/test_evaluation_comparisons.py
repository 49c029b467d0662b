"""The words of the report, against numbers that are known."""

from __future__ import annotations

from pathlib import Path

from services.commands.evaluation.report.comparisons import compare_recognition, compare_searches, long_sequences
from services.commands.evaluation.report.summary import Success, recognised, successes
from tests.services.commands.evaluation.evaluated import SMALL, finished

(WORLD,) = SMALL.worlds


def test_words_follow_the_numbers(tmp_path: Path) -> None:
    planned, store = finished(tmp_path)
    recognition = compare_recognition("yard", recognised(WORLD, planned, store.findings))
    verdicts = {one.text.split(" of ")[2].split(",")[0] + one.text.split(":")[0]: one.verdict for one in recognition}
    assert verdicts["single image (l = 1)recognition, occluded"] == "ahead"
    # Of whole windows all find everything; a single image has the first frames as well.
    assert verdicts["single image (l = 1)recognition, clean"] != "ahead"
    searches = compare_searches("yard", successes(WORLD, planned, store.findings))
    said = {one.text: one.verdict for one in searches}
    (against,) = [text for text in said if "occluded" in text and "single image" in text]
    assert said[against] == "ahead"
    assert "8 of 8 found by SMAL, l = 5 against 0 of 8" in against
    assert "p = 0.0078" in against
    assert all(verdict == "open" for text, verdict in said.items() if "clean" in text)


def test_a_few_wins_are_no_proof() -> None:
    def counted(controller: str, length: int, found: int) -> Success:
        outcomes = {seed: "found" if seed < found else "timeout" for seed in range(8)}
        return Success(controller, length, "clean", outcomes, dict.fromkeys(range(8), 100))

    (close,) = compare_searches("yard", [counted("smal", 5, 8), counted("smal", 1, 4)])
    assert close.verdict == "open"
    (lost,) = compare_searches("yard", [counted("smal", 5, 1), counted("smal", 1, 8)])
    assert lost.verdict == "behind"
    assert "SMAL is behind" in lost.text


def test_long_sequences_are_compared_with_the_best_length(tmp_path: Path) -> None:
    planned, store = finished(tmp_path)
    said = {one.text: one.verdict for one in long_sequences("yard", successes(WORLD, planned, store.findings))}
    (paper,) = [text for text in said if text.startswith("lengths, paper, clean")]
    assert paper.endswith("8 of 8 at l = 1, 8 of 8 at l = 5, 0 of 8 at l = 20; long sequences lose against l = 1")
    (ours,) = [text for text in said if text.startswith("lengths, smal, clean")]
    assert ours.endswith("8 of 8 at l = 20; long sequences are as good as the best")
    assert set(said.values()) == {"counts"}


def test_a_length_that_never_succeeds_is_as_good_as_no_other() -> None:
    lost = [Success("paper", length, "poor", dict.fromkeys(range(3), "timeout"), {}) for length in (1, 5, 20)]
    (said,) = long_sequences("yard", lost)
    assert said.text.endswith("0 of 3 at l = 20; no length finds the victim")

"""Two seconds of the fuzzer for every decoder: enough to notice that one broke, or that the fuzzer no longer runs."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.fuzz.campaign import fuzz
from tests.fuzz.targets import NAMES

pytest.importorskip("atheris", reason="atheris is not installed; it has wheels for Linux on x86-64 only")
SECONDS = 2


@pytest.mark.parametrize("name", NAMES)
def test_two_seconds_of_fuzzing_find_nothing(name: str, tmp_path: Path) -> None:
    campaign = fuzz(name, SECONDS, tmp_path)
    assert campaign.clean, f"{campaign.line()}\n{campaign.finding}"

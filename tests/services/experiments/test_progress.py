"""What a terminal shows of progress."""

import os
import pty
import sys

import pytest

from services.experiments.progress import Bars


def test_a_terminal_that_does_not_tell_its_size_shows_a_bar(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    ours, theirs = pty.openpty()  # It is 0 columns wide and 0 rows high.
    with (
        os.fdopen(ours, "rb", buffering=0) as screen,
        os.fdopen(theirs, "w", encoding="utf-8") as terminal,
    ):
        monkeypatch.setattr(sys, "stderr", terminal)
        bars = Bars()
        bars("reading", 1, 2)
        bars.close()
        shown = screen.read(1000)
    assert b"reading:  50%" in shown

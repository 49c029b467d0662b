"""Progress on a terminal, and in a pipe."""

import os
import pty
import sys
import time

import pytest

from services.experiments import progress
from services.experiments.progress import Bars, bar_of


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


def test_pipe_gets_a_line_every_ten_seconds(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    now_s = [0.0]
    monkeypatch.setattr(time, "monotonic", lambda: now_s[0])
    for count, name in ((300, "searching"), (5, "short")):
        bar = bar_of(range(count), desc=name, mininterval=0.0)
        for _ in bar:
            now_s[0] += 0.1
            bar.set_postfix_str("frame 7")
    shown = capfd.readouterr().err
    assert [line.partition("%")[0] for line in shown.splitlines()] == [
        "searching:  33",
        "searching:  67",
        "searching: 100",
    ]
    assert "\r" not in shown


def test_first_item_gives_an_estimate(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(progress, "LINE_S", 0.0)
    bars = Bars()
    bars("reading", 1, 3)
    bars.close()
    assert "1/3 [00:00<00:00" in capfd.readouterr().err

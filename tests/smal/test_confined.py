"""Work with foreign files ends: by its result, by its error, by a bound, or because it is cancelled."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from smal.files import confined as module
from smal.files.confined import ConfinedError, WorkLimits, confined, size_of

ROOT = Path(__file__).parents[2]
SMALL = WorkLimits(2**28, 0.5)


@pytest.fixture(autouse=True)
def found_by_the_child(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    monkeypatch.setattr(module, "_WAITING", 1e3)  # On a loaded machine the clock runs far ahead.


def does(work: str, request: object = None, limits: WorkLimits = SMALL, **how: Any) -> Any:
    return confined(f"tests.confined_work:{work}", request, limits, "some.file", **how)


def failure(work: str, request: object = None) -> str:
    with pytest.raises(ConfinedError, match=r"\Asome.file: [^\n]+\Z") as caught:
        does(work, request)
    return str(caught.value)


def test_work_returns_its_result_when_it_prints() -> None:
    assert does("echo", {"a": ["ü", 1.5, None]}) == {"a": ["ü", 1.5, None]}


def test_step_ends_when_it_takes_too_much_time() -> None:
    expected = "reading an image of it takes more than 0.5 s of processor time"
    assert expected in failure("loop_in_a_step", 0.5)


def test_work_goes_on_when_it_reports_progress() -> None:
    seen: list[float] = []
    assert does("go_on", 2.0, progress=seen.append) >= 2.0
    assert len(seen) > 10


def test_work_ends_when_it_takes_all_memory() -> None:
    assert "takes more than 0.25 GiB of memory" in failure("fill")


def test_work_ends_in_one_line_when_it_crashes() -> None:
    assert "broke down (status -11)" in failure("crash")


def test_work_ends_when_it_makes_no_progress(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_WAITING", 2.0)
    assert "takes more than 1 s without progress" in failure("sleep")


def test_refusal_of_the_work_is_raised_when_it_refuses() -> None:
    with pytest.raises(ConfinedError, match=r"\Athis: is of no use\Z"):
        does("refuse", "this")


def test_limits_grow_when_the_user_raises_them(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SMAL_LIMITS", "1.5")
    said = failure("loop")
    assert "takes more than 0.75 s of processor time" in said
    assert "SMAL_LIMITS=3 doubles the limit" in said
    monkeypatch.setenv("SMAL_LIMITS", "much")
    with pytest.raises(ConfinedError, match="SMAL_LIMITS=much: must be a number from 1 to 1000000"):
        does("echo")


def test_child_ends_when_the_work_is_cancelled() -> None:
    children: list[int] = []

    def go_on() -> None:
        if children:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        does("sleep", progress=children.append, go_on=go_on)
    with pytest.raises(ProcessLookupError):
        os.kill(children[0], 0)


@pytest.mark.skipif(sys.platform != "linux", reason="the kernel of Linux ends the child")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_child_ends_when_its_parent_is_ended(number: signal.Signals) -> None:
    program = (
        "from smal.files.confined import WorkLimits, confined\n"
        "limits = WorkLimits(2**28, 60.0)\n"
        "confined('tests.confined_work:sleep', None, limits, 'x', progress=lambda n: print(n, flush=True))"
    )
    with subprocess.Popen(
        [sys.executable, "-c", program], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
    ) as parent:
        child = int(parent.stdout.readline())
        parent.send_signal(number)
        parent.wait()
    while (
        Path(f"/proc/{child}/stat").exists()
        and Path(f"/proc/{child}/stat").read_text().split()[2] != "Z"
    ):
        time.sleep(0.01)  # The timeout of the test ends this where the child lives on.


def test_holes_do_not_count_when_a_source_is_measured(tmp_path: Path) -> None:
    with (tmp_path / "sparse").open("wb") as file:
        file.truncate(10**12)
    (tmp_path / "full").write_bytes(os.urandom(100_000))
    assert 100_000 <= size_of(tmp_path) < 200_000
    assert size_of(tmp_path / "none") == 0

"""Long jobs run as processes: they report progress, can be cancelled, and leave nothing behind."""

import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from services.console.browser_messages import Add
from services.console.jobs import BackgroundJob, Jobs
from services.console.library import Library
from services.console.service import ConsoleService
from services.kit.node import ServiceError
from smal.model import Model
from tests import corridor
from tests.services.cli.test_adding import run
from tests.services.recordings.test_recorder_files import record
from tests.services.waiting import DEADLINE_S, eventually

JobsOf = Callable[[str], tuple[Jobs, list[dict[str, object]]]]
SCRIPT = """
import signal, sys, time
STAGE = '{"stage": "deaf", "done": 1, "total": 1}'
print('{"stage": "reading", "done": 1, "total": 4}', flush=True)
print("a line for people", flush=True)
"""


@pytest.fixture
def jobs_of(monkeypatch: pytest.MonkeyPatch) -> JobsOf:
    """Give what runs a script as a job's command, and what is shown of it."""

    def of(script: str) -> tuple[Jobs, list[dict[str, object]]]:
        monkeypatch.setattr(
            "services.console.jobs._COMMAND", (sys.executable, "-c", SCRIPT + script)
        )
        shown: list[dict[str, object]] = []
        return Jobs(shown.append), shown

    return of


def learning(out: Path) -> BackgroundJob:
    arguments = ("learn", "a.mcap")
    return BackgroundJob(
        "model", out.stem, f"Learning {out.stem}", "it is learned", arguments, out, "/root/"
    )


def ended(shown: list[dict[str, object]]) -> dict[str, object]:
    """Wait until a job has ended; return what is shown of it."""
    return eventually(lambda: shown[-1] if shown and "outcome" in shown[-1] else {}, DEADLINE_S)


@pytest.mark.parametrize(
    ("script", "outcome", "why"),
    [
        ("", "done", ""),
        (
            "sys.stderr.write('smal: left out\\nsmal: /root/a: no\\n'); sys.exit(1)",
            "failed",
            "a: no",
        ),
        ("sys.exit(1)", "failed", "a line for people"),
    ],
)
def test_a_job_tells_how_far_it_is_and_how_it_ended(
    jobs_of: JobsOf, tmp_path: Path, script: str, outcome: str, why: str
) -> None:
    jobs, shown = jobs_of(script)
    jobs.begin(learning(tmp_path / "models" / "way.smal"))
    end = ended(shown)
    said = {"kind": "model", "name": "way", "doing": "Learning way", "done": "it is learned"}
    reading = next(one for one in shown if one.get("stage") == "reading")
    left_s = reading.pop("left_s")
    assert reading == {**said, "stage": "reading", "share": 0.25}
    assert left_s >= 0.0
    assert (end["outcome"], end["why"]) == (outcome, why)
    assert not jobs.running


def test_a_job_is_cancelled_and_one_runs_at_a_time(jobs_of: JobsOf, tmp_path: Path) -> None:
    jobs, shown = jobs_of("time.sleep(60)")
    jobs.begin(learning(tmp_path / "way.smal"))
    with pytest.raises(ServiceError, match="another job is running"):
        jobs.begin(learning(tmp_path / "other.smal"))
    eventually(lambda: any(one.get("stage") == "reading" for one in shown))
    jobs.cancel()
    assert ended(shown)["outcome"] == "cancelled"
    (tmp_path / "way.smal").touch()
    with pytest.raises(ServiceError, match="choose another name"):
        jobs.begin(learning(tmp_path / "way.smal"))
    jobs.begin(replace(learning(tmp_path / "way.smal"), renews=True))
    jobs.cancel()
    eventually(lambda: not jobs.running)


#: As one that calculates something in one piece does.
DEAF = "signal.signal(signal.SIGTERM, signal.SIG_IGN); print(STAGE, flush=True); time.sleep(60)"


@pytest.mark.parametrize(
    ("patience_s", "outcome", "why"), [(60.0, "cancelled", ""), (3.0, "failed", "no output for")]
)
def test_a_job_that_does_not_hear_is_ended(
    jobs_of: JobsOf,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    patience_s: float,
    outcome: str,
    why: str,
) -> None:
    monkeypatch.setattr("services.console.jobs._ENDING_S", 0.1)
    monkeypatch.setattr("services.console.jobs.PATIENCE_S", patience_s)
    jobs, shown = jobs_of(DEAF)
    jobs.begin(learning(tmp_path / "way.smal"))
    eventually(lambda: any(one.get("stage") == "deaf" for one in shown))
    if outcome == "cancelled":
        jobs.cancel()
    end = ended(shown)
    assert (end["outcome"], str(end["why"]).startswith(why)) == (outcome, True)
    assert not jobs.running


@pytest.mark.long
def test_model_learns_more_from_runs_and_reports_the_result(tmp_path: Path) -> None:
    (tmp_path / "models").mkdir()
    (tmp_path / "drives").mkdir()
    model = corridor.save_model(tmp_path / "models" / "way.smal")
    for number in range(6):
        record(tmp_path / "drives", list(run(f"run-{number}", 0.6)))
    library = Library(tmp_path)
    shown = list[dict[str, object]]()
    library.look()
    console = SimpleNamespace(library=library, _jobs=Jobs(shown.append))
    runs = tuple(one.name for one in library.recordings())
    ask = Add(do="add", beat=0, model="models/way.smal", recordings=runs)
    ConsoleService._learn(console, ask)
    end = ended(shown)  # it gives way to all that a busy machine does
    assert (end["outcome"], end["done"]) == ("done", "way has learned from these runs."), end
    assert "map extended with new view variants" in str(end["remarks"])
    assert len(Model.load(model).mapped.variants) > 0
    with pytest.raises(ServiceError, match="model not found"):
        ConsoleService._learn(console, ask.model_copy(update={"model": "models/none.smal"}))

"""What takes long is a process of its own: it tells how far it is, is cancelled, and leaves nothing behind."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from services.console.folder import Folder
from services.console.jobs import Job, Jobs
from services.kit.node import ServiceError
from tests.services.waiting import eventually

SCRIPT = """
import signal, sys, time
STAGE = '{"stage": "deaf", "done": 1, "total": 1}'
print('{"stage": "reading", "done": 1, "total": 4}', flush=True)
print("a line for people", flush=True)
"""


def jobs_of(script: str, patience_s: float = 60.0) -> tuple[Jobs, list[dict[str, object]]]:
    shown: list[dict[str, object]] = []
    return Jobs(shown.append, (sys.executable, "-c", SCRIPT + script), patience_s), shown


def learning(out: Path, needs: Folder | None = None) -> Job:
    arguments = ("learn", "a.mcap")
    return Job("model", out.stem, f"Learning {out.stem}", "it is learned", arguments, out, "/root/", needs)


@pytest.mark.parametrize(
    ("script", "outcome", "why"),
    [
        ("", "done", ""),
        ("sys.stderr.write('smal: left out\\nsmal: /root/a: no\\n'); sys.exit(1)", "failed", "a: no"),
        ("sys.exit(1)", "failed", "it ended with status 1"),
    ],
)
def test_a_job_tells_how_far_it_is_and_how_it_ended(tmp_path: Path, script: str, outcome: str, why: str) -> None:
    jobs, shown = jobs_of(script)
    needed = Folder()
    jobs.begin(learning(tmp_path / "models" / "way.smal", needed))
    eventually(lambda: not jobs.running)
    end = eventually(lambda: shown[-1] if "outcome" in shown[-1] else None)
    said = {"kind": "model", "name": "way", "doing": "Learning way", "done": "it is learned"}
    assert {**said, "stage": "reading", "share": 0.25} in shown
    assert (end["outcome"], end["why"]) == (outcome, why)
    assert not needed.path.exists()


def test_a_job_is_cancelled_and_one_runs_at_a_time(tmp_path: Path) -> None:
    jobs, shown = jobs_of("time.sleep(60)")
    jobs.begin(learning(tmp_path / "way.smal"))
    with pytest.raises(ServiceError, match="something else is being made"):
        jobs.begin(learning(tmp_path / "other.smal"))
    eventually(lambda: any(one.get("stage") == "reading" for one in shown))
    jobs.cancel()
    eventually(lambda: shown[-1].get("outcome") == "cancelled")
    (tmp_path / "way.smal").touch()
    needed = Folder()
    with pytest.raises(ServiceError, match="choose another name"):
        jobs.begin(learning(tmp_path / "way.smal", needed))
    assert not needed.path.exists()


#: As one that calculates something in one piece does.
DEAF = "signal.signal(signal.SIGTERM, signal.SIG_IGN); print(STAGE, flush=True); "


@pytest.mark.parametrize("how", ["cancelled", "says nothing"])
def test_a_job_that_does_not_hear_is_ended(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, how: str) -> None:
    monkeypatch.setattr("services.console.jobs._ENDING_S", 0.1)
    jobs, shown = jobs_of(DEAF + "time.sleep(60)", patience_s=60.0 if how == "cancelled" else 3.0)
    jobs.begin(learning(tmp_path / "way.smal"))
    eventually(lambda: any(one.get("stage") == "deaf" for one in shown))
    if how == "cancelled":
        jobs.cancel()
    end = eventually(lambda: shown[-1] if "outcome" in shown[-1] else None, timeout_s=20.0)
    assert not jobs.running
    if how == "cancelled":
        assert end["outcome"] == "cancelled"
    else:
        assert (end["outcome"], "it has said nothing for" in str(end["why"])) == ("failed", True)


def test_another_job_begins_where_the_last_one_s_folder_could_not_be_removed(tmp_path: Path) -> None:
    jobs, shown = jobs_of("")
    needed = Folder()
    needed.path.rmdir()
    jobs.begin(learning(tmp_path / "way.smal", needed))
    eventually(lambda: shown and shown[-1].get("outcome") == "done")
    jobs.begin(learning(tmp_path / "other.smal"))
    eventually(lambda: shown[-1].get("name") == "other" and shown[-1].get("outcome") == "done")

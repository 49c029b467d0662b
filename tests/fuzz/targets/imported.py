"""What the four formats of ``smal import`` share: a source of which one file is the input."""

from __future__ import annotations

import shutil
from pathlib import Path

from services.importers.drive import ImportFailure, Tally
from services.importers.job import Format, Job
from services.importers.run import run
from tests.fuzz.targets import check_line, scratch


def accepted(form: Format, source: Path) -> bool:
    """Import a source, and say whether that was possible; what is said of it is lines, either way."""
    out = scratch.folder() / "out"
    out.mkdir(exist_ok=True)
    tally = Tally()
    job = Job(format=form, path=str(source), folder=str(out), robot="burger")
    try:
        report = run(job, tally)
    except ImportFailure as error:
        check_line(error)
        return False
    finally:
        shutil.rmtree(out)
        for line in tally.lines():
            check_line(line)
    assert report.ticks > 0
    return True

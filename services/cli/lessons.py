"""The parts that `smal learn` and `smal paper learn` share: they read the recordings, and report the model."""

import time
from pathlib import Path
from typing import Any

import typer

from services.cli import outputs
from services.experiments.progress import Bars
from services.experiments.words import counted, remark
from services.kit.errors import JobError, UsageError
from services.recordings.dataset import Teacher, Teaching
from smal.features import FeatureSettings


def check_out(out: Path, json_file: Path | None) -> None:
    """Check the paths of the model and of the report, before any recording is read."""
    if out.is_dir():
        raise UsageError(
            f"--out {out}: is a folder; give the name of a file, for example {out / 'model.smal'}"
        )
    outputs.check_file(json_file, "--json")


def taught_by(
    files: list[Path], features: FeatureSettings, shortest: int, include_runs: bool, bars: Bars
) -> Teaching:
    """Read recordings; JobError if they teach nothing."""
    teaching = Teacher(features, shortest, include_runs=include_runs).read_all(files, bars)
    bars.close()
    if not teaching.demonstrations and len(teaching.remarks) == 1:
        raise JobError(teaching.remarks[0])
    remark(teaching.remarks)
    if not teaching.demonstrations:
        raise JobError(
            f"nothing to learn from in {counted(len(files), 'recording')}, for the reasons above"
        )
    return teaching


def tell(
    rows: dict[str, Any],
    out: Path,
    began_s: float,
    json_file: Path | None,
    content: dict[str, Any] | None = None,
) -> None:
    """Print the rows of a report, and write its content as JSON if asked to; without a content that is the rows."""
    if json_file is not None:
        outputs.write_json(
            json_file, "--json", {"model": str(out)} | (rows if content is None else content)
        )
    for name, value in (
        rows | {"seconds": f"{time.perf_counter() - began_s:.1f}", "model": out}
    ).items():
        typer.echo(f"{name.replace('_', ' '):16}{value}")


def tell_learned(
    found: dict[str, Any],
    teaching: Teaching,
    features: FeatureSettings,
    out: Path,
    began_s: float,
    json_file: Path | None,
) -> None:
    """Report the recordings that taught a new model, and the model."""
    used = {
        "recordings": teaching.recordings,
        "episodes": teaching.episodes,
        "remarks": teaching.remarks,
    }
    recorded = f"{teaching.recordings} ({counted(teaching.episodes, 'episode')} used)"
    rows = {"recordings": recorded, "features": " ".join(features.modalities)} | found
    tell(rows, out, began_s, json_file, used | {"modalities": features.modalities} | found)

"""Options and steps shared by `smal learn` and `smal paper learn`."""

import time
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import typer
from typer import Argument, Option

from services.cli import options, outputs
from services.experiments.progress import Bars
from services.experiments.words import counted, remark, table
from services.kit.errors import JobError, UsageError
from services.kit.model_service import AnyModel
from services.recordings.dataset import Teacher, Teaching, find_recordings
from services.simulator.world import known_worlds
from smal.features import FeatureSettings
from smal.files.container import ModelError
from smal.teaching.demonstration import DriveUse


@dataclass(frozen=True)
class Lessons:
    """Recordings to learn from, and files of the result."""

    recordings: Annotated[list[Path], Argument(help="Recordings (MCAP), or folders of recordings.")]
    out: Annotated[Path, Option(help="File of the model.")]
    modalities: options.Modalities = None
    include_runs: Annotated[
        bool, Option(help="Successful runs of the robot as further drives.")
    ] = False
    json_file: options.JsonFile = None
    progress: Annotated[bool, Option("--progress", help="Progress as lines of JSON.")] = False

    def check(self) -> None:
        """Check the output paths before any recording is read."""
        if self.out.is_dir():
            example = self.out / "model.smal"
            raise UsageError(
                f"--out {self.out}: is a folder; choose a file name, for example {example}"
            )
        outputs.check_file(self.json_file, "--json")

    @contextmanager
    def bars(self) -> Iterator[Bars]:
        """Show progress bars, or lines of JSON with --progress."""
        with closing(Bars(as_json=self.progress)) as bars:
            yield bars

    def find(self) -> tuple[list[Path], FeatureSettings]:
        """Return the recordings and feature settings; create the folder of the model."""
        outputs.make_folder(self.out.parent, "--out")
        files = find_recordings(self.recordings)
        return files, self.modalities or FeatureSettings()

    def taught(
        self, files: list[Path], features: FeatureSettings, shortest: int, bars: Bars
    ) -> Teaching:
        """Read recordings; raise JobError if they teach nothing."""
        teacher = Teacher(features, shortest, include_runs=self.include_runs)
        teaching = teacher.read_all(files, bars)
        bars.close()
        reasons = teaching.lines()
        if teaching.demonstrations:
            remark(teaching.remarks)
        elif len(reasons) == 1:
            raise JobError(reasons[0])
        else:
            remark(reasons)
            what = counted(len(files), "recording")
            raise JobError(f"{what}: nothing to learn from; see the reasons above")
        return teaching

    def report(
        self, rows: dict[str, Any], began_s: float, content: dict[str, Any] | None = None
    ) -> None:
        """Print the rows of a report; write them, or other content, as JSON if requested."""
        if self.json_file is not None:
            written = {"model": str(self.out)} | (rows if content is None else content)
            outputs.write_json(self.json_file, "--json", written)
        rows = rows | {"seconds": f"{time.perf_counter() - began_s:.1f}", "model": self.out}
        for name, value in rows.items():
            typer.echo(f"{name.replace('_', ' '):16}{value}")

    def finish(
        self, model: AnyModel, found: dict[str, Any], teaching: Teaching, began_s: float
    ) -> None:
        """Save a new model and report it with its recordings, and the use of each drive."""
        save(model, self.out)
        modalities = model.feature_settings.modalities
        episodes = sum(use.used > 0 for use in teaching.uses)
        used = {
            "recordings": teaching.recordings,
            "episodes": episodes,
            "remarks": teaching.remarks,
            "uses": [asdict(use) for use in teaching.uses],
            "modalities": modalities,
        }
        rows = {
            "recordings": f"{teaching.recordings} ({counted(episodes, 'episode')} used)",
            "features": " ".join(modalities),
        }
        self.report(rows | found, began_s, used | found)
        for line in table_of(teaching.uses):
            typer.echo(line)
        simulated = teaching.world in known_worlds()
        following = f"run --world {teaching.world}" if simulated else "up"
        typer.echo(f"next: smal {following} --model {self.out}")


def table_of(uses: Sequence[DriveUse]) -> Iterator[str]:
    """Yield the lines of a table of how many frames of each drive teach."""
    cells = [[use.drive, str(use.frames), str(use.used)] for use in uses]
    lines = table([["drive", "frames", "used"], *cells])
    notes = ["note", *(use.note for use in uses)]
    return (f"{line}  {note}".rstrip() for line, note in zip(lines, notes, strict=True))


def save(model: AnyModel, path: Path) -> None:
    """Write a model; raise JobError if it is too large."""
    try:
        model.save(path)
    except ModelError as error:
        raise JobError(str(error)) from None

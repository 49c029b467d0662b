"""Recordings that are not sealed, damaged, or in several files become a sealed one of all that is whole in them."""

import os
import tempfile
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from pathlib import Path

from services.kit.errors import JobError
from services.recordings.contents import Contents, verify
from services.recordings.sink import PARTIAL_SUFFIX, claim, finished, free_path, publish
from services.recordings.stream import messages, open_recording
from services.recordings.survey import surveyed
from services.recordings.writer import EpisodeWriter


def usual_name(path: Path, *, replace: bool) -> Path:
    """Return where the repaired recording goes if nobody says; it is there already only where it replaces its own."""
    if path.suffix == PARTIAL_SUFFIX:
        return finished(path)
    return path if replace else free_path(path.parent, f"{path.stem}-repaired")


def repair(
    paths: Sequence[Path], out: Path, *, replace: bool = False
) -> tuple[list[Contents], Contents | None]:
    """Write the recording of all that is whole in others, which are of one episode; return what was wrong, and is.

    The second is None where nothing was to be repaired. ``replace`` replaces a file that is there, and removes what was
    left behind. JobError where nothing can be made of them, one is being recorded, or there is a file already.
    """
    before = [verify(path) for path in paths]
    if len(before) == 1 and before[0].state == "sealed" and not before[0].damage:
        return before, None
    for one in before:
        if len(one.episodes) != 1:
            several = f"{len(one.episodes)} episodes; one can be repaired at a time"
            raise JobError(
                f"{one.path}: holds {several if one.episodes else 'nothing of an episode to save'}"
            )
        first = before[0].episodes[0]
        other = one.episodes[0]
        if (first.robot, first.episode) != (other.robot, other.episode):
            raise JobError(
                f"{one.path}: is of episode {other.episode}, and {before[0].path} of {first.episode}"
            )
    left = [path for path in paths if path.suffix == PARTIAL_SUFFIX]
    with (
        ExitStack() as held,
        tempfile.TemporaryDirectory(prefix=".repair-", dir=out.parent) as folder,
    ):
        for path in left:
            try:
                held.callback(
                    os.close, claim(path)
                )  # Recorders keep away from what one of them left behind.
            except BlockingIOError:
                raise JobError(
                    f"{path}: still being recorded; end the episode or stop the recorder first"
                ) from None
        made = _written(before, Path(folder) / out.name)
        after = verify(made)
        if out.exists() and not replace:
            raise JobError(f"{out}: is there already; give another name, or --replace")
        publish(made, out)
        for path in left if replace else ():
            path.unlink()
    after.path = out
    return before, after


def _written(before: Sequence[Contents], out: Path) -> Path:
    (episode,) = before[0].episodes
    metadata = {name: str(value) for name, value in episode.said.items()} | before[0].about
    metadata |= {"robot": episode.robot, "episode": episode.episode}
    writer = EpisodeWriter(out.with_name(f"{out.name}{PARTIAL_SUFFIX}"), out, metadata)
    try:
        for one in before:
            # `verify` has told of what is not whole; a message that does not decode is left out.
            for stored in messages(
                surveyed(open_recording(one.path, living=True), lambda _line: None)
            ):
                with suppress(ValueError):
                    writer.write(stored.message(pixels=True))
    finally:
        sealed = writer.seal()
    if sealed != out:
        raise JobError(f"{out.name}: cannot be written: {writer.problem}")
    return sealed

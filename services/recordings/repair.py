"""Repair of recordings that are unsealed, damaged, or in several files."""

import os
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from services.kit.errors import JobError
from services.recordings.contents import Contents, EpisodeContents, verify
from services.recordings.sink import PARTIAL_SUFFIX, claim, finished, free_path, publish
from services.recordings.stream import messages, open_recording
from services.recordings.survey import surveyed
from services.recordings.writer import EpisodeWriter


def usual_name(path: Path, *, replace: bool) -> Path:
    """Return the default name of the repaired recording."""
    if path.suffix == PARTIAL_SUFFIX:
        return finished(path)
    return path if replace else free_path(path.parent, f"{path.stem}-repaired")


def repair(
    paths: Sequence[Path], out: Path, *, replace: bool = False
) -> tuple[list[Contents], Contents | None]:
    """Write one sealed recording of all complete messages in recordings of one episode.

    Parameters
    ----------
    replace
        Replace an existing ``out``, and delete the files that a recorder left behind.

    Returns
    -------
    The contents of the recordings, and those of ``out``, or None if no repair is needed.

    Raises
    ------
    JobError
        If the recordings are not of one episode, one is being recorded, or ``out`` exists.
    """
    before = [verify(path) for path in paths]
    if len(before) == 1 and before[0].state == "sealed" and not before[0].damage:
        return before, None
    _check_one_episode(before)
    left = [path for path in paths if path.suffix == PARTIAL_SUFFIX]
    with (
        _claimed(left),
        tempfile.TemporaryDirectory(prefix=".repair-", dir=out.parent) as folder,
    ):
        made = _written(before, Path(folder) / out.name)
        after = verify(made)
        if out.exists() and not replace:
            raise JobError(f"{out}: already exists; choose another name, or give --replace")
        publish(made, out)
        for path in left if replace else ():
            path.unlink()
    after.path = out
    return before, after


def _check_one_episode(recordings: Sequence[Contents]) -> None:
    first: EpisodeContents | None = None
    for one in recordings:
        if not one.episodes:
            raise JobError(f"{one.path}: no messages of an episode to save")
        if len(one.episodes) > 1:
            count = len(one.episodes)
            raise JobError(f"{one.path}: {count} episodes; only one can be repaired at a time")
        (episode,) = one.episodes
        first = first or episode
        if (first.robot, first.episode) != (episode.robot, episode.episode):
            raise JobError(
                f"{one.path}: episode {episode.episode} differs from {first.episode} in "
                f"{recordings[0].path}"
            )


@contextmanager
def _claimed(left: Sequence[Path]) -> Iterator[None]:
    """Lock the files that a recorder left behind."""
    with ExitStack() as held:
        for path in left:
            try:
                held.callback(os.close, claim(path))
            except BlockingIOError:
                raise JobError(
                    f"{path}: still being recorded; end the episode or stop the recorder first"
                ) from None
        yield


def _written(before: Sequence[Contents], out: Path) -> Path:
    (episode,) = before[0].episodes
    metadata = {name: str(value) for name, value in episode.said.items()} | before[0].about
    metadata |= {"robot": episode.robot, "episode": episode.episode}
    writer = EpisodeWriter(out.with_name(f"{out.name}{PARTIAL_SUFFIX}"), out, metadata)
    try:
        for one in before:
            # `verify` has reported the damage; undecodable messages are left out.
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

"""Recorder on the bus: writes one file per episode."""

import math
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Final, cast

from schemas.base import Message
from schemas.codec import encode, printable
from schemas.episode import Episode
from schemas.rpc import Nothing, RecordReply, RecordRequest
from schemas.topics import EPISODE, TOPICS
from services.kit.inbox import Inbox
from services.kit.node import Detail, Node, ServiceError
from services.kit.root import RootSettings, below
from services.recorder.disk import LOOK_S, Disk
from services.recordings.leftover import LeftoverError, Sealed, seal_leftover
from services.recordings.sink import leftovers
from services.recordings.stream import RecordingError, messages_of
from services.recordings.writer import EpisodeWriter

#: Queue length for a slow disk, as a multiple of the replayed messages after an outage.
QUEUE_FACTOR: Final = 2
#: The file of an episode stays open after its end for late messages: for ``QUIET_S`` without a
#: message if all ticks are complete, else for ``GRACE_S``.
QUIET_S: Final = 0.2
GRACE_S: Final = 1.0
#: Topics are ordered only within themselves. Messages wait this long for the start of their
#: episode, within these limits. JPEG of half a megabyte at 10 Hz are 25 MB in that time. A slow
#: machine receives replayed messages repeatedly: 16 topics of 300 messages in a test of 40 frames.
EARLY_S: Final = 5.0
_EARLY_QUEUE: Final = 1 << 15
_EARLY_BYTES: Final = 64 << 20
_SETTLE_S: Final = 10.0  # Timeout of `flush` and `stop` for that.
SEAL_PERIOD_S: Final = 0.05


class RecorderSettings(RootSettings):
    """Settings of the recorder."""

    recordings: Path | None = None
    """Folder, at any place, to record every episode in from the start; without it, recording waits for
    the call ``start`` with a folder below the root."""


@dataclass
class _Recording:
    """An episode being recorded; without a writer its messages are dropped."""

    writer: EpisodeWriter | None
    touched_s: float
    # Until then senders can replay messages that a killed recorder missed.
    not_before_s: float = 0.0
    closing: bool = False
    deadline_s: float = math.inf  # For an episode whose end was not received.

    def complete(self, now_s: float) -> bool:
        """Whether no more messages are expected."""
        quiet = now_s - self.touched_s >= (QUIET_S if self._whole() else GRACE_S)
        return now_s >= self.deadline_s or (self.closing and quiet and now_s >= self.not_before_s)

    def _whole(self) -> bool:
        """Whether every tick up to the end of the episode is recorded."""
        writer = self.writer
        return (
            writer is not None
            and writer.end_tick is not None
            and writer.ledger.whole(writer.end_tick)
        )


class RecorderService:
    """Records episodes, each from its ``started`` to its ``ended``.

    The recorder starts with a folder (ServiceError if unusable), or waits for the call ``start``
    with a folder below the root.
    """

    def __init__(
        self,
        node: Node,
        root: Path,
        folder: Path | None = None,
        clock: Callable[[], float] = time.monotonic,
        disk: Disk | None = None,
    ) -> None:
        self._node = node
        self._root = root
        self._clock = clock
        self._disk = disk or Disk(clock)
        self._folder: Path | None = None
        self._open: dict[str, _Recording] = {}
        self._early = Inbox(clock, _EARLY_BYTES)
        self._early.open("early", _EARLY_QUEUE)
        self._files: list[Path] = []
        #: Episodes that a killed recorder began. Senders replay the rest soon after this time.
        self._cut: set[str] = set()
        self._done: set[str] = set()  # Episodes whose recordings are complete.
        self._began_s = 0.0
        self._given_up: set[Path] = set()  # Leftovers that cannot be sealed.
        self._sealed: Counter[str] = Counter()
        self._lost = 0
        self._dropped_before = 0
        self._last_error: str | None = None
        if folder is not None:
            try:
                self._record_in(folder)
            except OSError as error:
                raise ServiceError(
                    f"cannot record in {folder}: {error.strerror or error}"
                ) from None
        for topic in TOPICS.values():
            if topic.recorded:
                node.subscribe(topic, self.handle, depth=QUEUE_FACTOR * topic.kept, replay=True)
        node.serve("start", RecordRequest, self.start)
        node.serve("flush", Nothing, self.flush)
        node.serve("stop", Nothing, self.stop)
        node.every(SEAL_PERIOD_S, self.seal_complete)
        node.every(LOOK_S, self.look_after_files)
        node.detail = self.detail

    # -- calls ----------------------------------------------------------------------------------------------------

    def start(self, request: RecordRequest) -> None:
        """Record the episodes that start from now on; a running episode stays in its file."""
        try:
            self._record_in(below(self._root, request.folder))
        except OSError as error:
            self._node.log.warning("cannot record in %r: %s", request.folder, error)
            # The reason can reveal which other files exist.
            named = printable(request.folder)
            raise ServiceError(
                f"cannot record in {named!r} below the root of the recorder"
            ) from None

    def flush(self, _request: Nothing) -> RecordReply:
        """Finish the files of ended episodes, and return the names of all files since ``start``."""
        return self._settled(self._folder)

    def stop(self, _request: Nothing) -> RecordReply:
        """Complete every file, also of a running episode, and stop recording."""
        folder = self._folder
        self._folder = None
        self._cut = set()
        self._close_all()
        return self._settled(folder)

    def close(self) -> None:
        """Complete every file at once; the process ends."""
        self._folder = None
        for episode in list(self._open):
            self._seal(episode)

    def _record_in(self, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        # The rest of such an episode becomes a separate recording.
        self._cut = {one.episode for one in self._seal_leftovers(folder) if not one.ended}
        self._began_s = self._clock()
        self._folder = folder.resolve()
        self._files = []
        self._lost = 0
        self._dropped_before = self._dropped_by_node()
        self._node.log.info("recording in %s", self._folder)

    def _seal_leftovers(self, folder: Path) -> list[Sealed]:
        """Seal the files of a killed recorder, and files that had no space for sealing."""
        partials = leftovers(folder) - self._given_up
        return [sealed for sealed in map(self._seal_leftover, partials) if sealed is not None]

    def _seal_leftover(self, partial: Path) -> Sealed | None:
        try:
            sealed = seal_leftover(partial)
        except LeftoverError as error:
            self._given_up.add(partial)
            self._node.log.warning("%s unchanged: %s", partial, error)
            return None
        except BlockingIOError:
            return None  # Its recorder is running.
        except OSError as error:
            why = error.strerror or error
            self._complain(f"cannot seal {partial}: {why}; retry at the next episode")
            return None
        done = f"removed {partial}" if sealed.path is None else f"sealed {sealed.path}"
        self._node.log.info("%s, left by a killed recorder", done)
        renamed = (sealed.path if file == partial else file for file in self._files)
        self._files = [file for file in renamed if file is not None]
        return sealed

    def _settled(self, folder: Path | None) -> RecordReply:
        """Record until every ended episode is past its grace time, and cut episodes are replayed."""

        def is_settled() -> bool:
            replayed = not self._cut or self._clock() - self._began_s > EARLY_S
            return replayed and not any(recording.closing for recording in self._open.values())

        self._node.spin(until=is_settled, timeout_s=_SETTLE_S)
        if folder is not None:
            self._seal_leftovers(folder)
        dropped = self._lost + self._dropped_by_node() - self._dropped_before
        return RecordReply(files=tuple(path.name for path in self._files), dropped=dropped)

    def _dropped_by_node(self) -> int:
        return sum(count for name, count in self._node.status().dropped.items() if name in TOPICS)

    # -- messages -------------------------------------------------------------------------------------------------

    def handle(self, message: Message) -> None:
        """Record one message."""
        event = message.event if isinstance(message, Episode) else None
        if isinstance(message, Episode) and event == "started" and self._folder is not None:
            self._begin(message, self._folder)
        recording = self._open.get(message.episode)
        if recording is not None:
            self._write(recording, message)
            if event == "started":
                self._write_early(recording, message.episode)
            recording.closing |= event == "ended"
        elif self._folder is not None and not self._is_recorded(message.episode, self._folder):
            lost = self._early.dropped.total()
            self._early.put("early", message, len(encode(message)))
            self._lost += self._early.dropped.total() - lost

    def _write_early(self, recording: _Recording, episode: str) -> None:
        """Record the messages that arrived before the start of their episode."""
        for _ in range(self._early.waiting()["early"]):
            item = self._early.take(0.0)
            assert item is not None  # noqa: S101 - one thread puts and takes
            message = cast("Message", item.content)
            if message.episode == episode:
                self._write(recording, message)
            else:
                self._early.put("early", message, len(encode(message)))

    def seal_complete(self) -> None:
        """Finish the files of complete episodes."""
        now_s = self._clock()
        for episode in [
            episode for episode, recording in self._open.items() if recording.complete(now_s)
        ]:
            self._seal(episode)
        # On a slow machine the start can still wait in the queue.
        while self._node.idle() and self._early.oldest_s() > EARLY_S:
            self._early.take(0.0)

    def look_after_files(self) -> None:
        """Write waiting messages, and seal the recordings before the disk is full."""
        for recording in self._open.values():
            if recording.writer is not None:
                self._try(recording, recording.writer.flush)
        writing = any(recording.writer is not None for recording in self._open.values())
        if self._open and not writing and self._disk.warning is not None:
            return  # The warning must stay as long as nothing is recorded.
        with suppress(OSError):  # The folder is gone, as the next write reports.
            if self._folder is None or self._disk.look(self._folder, self._figures()["size"]):
                return
            for recording in self._open.values():
                if recording.writer is not None:
                    self._complain(f"{self._disk.warning}; earlier messages are sealed")
                    self._finish(recording)

    def _is_recorded(self, episode: str, folder: Path) -> bool:
        """Return whether a recording holds a complete episode with all its replayed messages.

        If a recorder stopped during an episode, it has sealed the first part.
        """
        path = folder / f"{episode}.mcap"
        if episode in self._cut or not path.exists():
            return False
        if episode not in self._done:
            (self._done if _has_end(path) else self._cut).add(episode)
        return episode in self._done

    def _begin(self, started: Episode, folder: Path) -> None:
        if started.episode in self._open or self._is_recorded(started.episode, folder):
            return
        # A robot runs one episode at a time: the end of the previous episode was lost.
        self._close_all()
        self._seal_leftovers(folder)
        writer = None
        try:
            self._disk.check_room(folder)
            writer = EpisodeWriter.begin(folder, started)
        except OSError as error:
            self._complain(f"cannot record episode {started.episode}: {error.strerror or error}")
        not_before_s = self._began_s + EARLY_S if started.episode in self._cut else 0.0
        self._open[started.episode] = _Recording(writer, self._clock(), not_before_s)

    def _write(self, recording: _Recording, message: Message) -> None:
        recording.touched_s = self._clock()
        writer = recording.writer
        if writer is None:
            self._lost += 1
        else:
            self._try(recording, lambda: writer.write(message))

    def _try(self, recording: _Recording, write: Callable[[], None]) -> None:
        """Write to a recording; finish it if that fails."""
        try:
            write()
        except OSError as error:
            self._disk.warning = f"{error.strerror or error}: recording stopped"
            self._finish(recording)

    def _close_all(self) -> None:
        for recording in self._open.values():
            if not recording.closing:
                recording.closing = True
                recording.deadline_s = self._clock() + GRACE_S

    def _seal(self, episode: str) -> None:
        self._finish(self._open.pop(episode))
        self._cut.discard(episode)
        self._done.add(episode)

    def _finish(self, recording: _Recording) -> None:
        writer = recording.writer
        recording.writer = None
        if writer is None:
            return
        path = writer.seal()
        if path != writer.path:
            self._complain(f"cannot seal {path}: {writer.problem}; retry at the next episode")
        self._lost += writer.waiting
        self._files.append(path)
        # A new object, because `detail` can be summing up the old one.
        self._sealed = self._sealed + _figures(writer)
        gaps = "".join(
            f"; missing frames of {topic}: {count}"
            for topic, count in writer.ledger.missing.items()
        )
        self._node.log.info(
            "%s: %d messages, %.1f MB%s", path, writer.messages, writer.size / 1e6, gaps
        )

    def _complain(self, problem: str) -> None:
        self._last_error = problem
        self._node.log.error("%s", problem)

    # -- health ---------------------------------------------------------------------------------------------------

    def _figures(self) -> Counter[str]:
        # Called on a thread of the bus, too: list() copies the open recordings at once.
        writers = [recording.writer for recording in list(self._open.values())]
        return sum((_figures(writer) for writer in writers if writer is not None), self._sealed)

    def detail(self) -> Detail:
        """Return the figures of this process."""
        totals = self._figures()
        return {
            "root": str(self._root),
            "folder": str(self._folder) if self._folder else None,
            "recording": " ".join(list(self._open)) or None,
            "files": len(self._files),
            "messages": totals["messages"],
            "megabytes": round(totals["size"] / 1e6, 3),
            "duplicates": totals["duplicates"],
            "gap_ticks": totals["gap_ticks"],
            "lost": self._lost,
            "disk": self._disk.warning,
            "last_error": self._last_error,
        }


def _has_end(path: Path) -> bool:
    """Return whether a recording holds the end of its episode; an unreadable file counts as complete."""
    events = (one.event for one in _events_in(path))
    with suppress(RecordingError):
        return "ended" in events
    return True


def _events_in(path: Path) -> Iterator[Episode]:
    for stored in messages_of(path, (EPISODE,)):
        with suppress(ValueError):
            yield cast("Episode", stored.message())


def _figures(writer: EpisodeWriter) -> Counter[str]:
    """Return the figures of a recording, to be summed."""
    ledger = writer.ledger
    messages = writer.messages - writer.waiting
    return Counter(
        messages=messages,
        size=writer.size,
        duplicates=ledger.duplicates,
        gap_ticks=ledger.gap_ticks,
    )

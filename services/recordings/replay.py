"""Replay of a recorded episode: the messages of each tick, and their times."""

from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, NamedTuple

from schemas import topics
from schemas.base import Message
from schemas.episode import Episode
from schemas.topics import Topic
from services.recordings.ledger import place_of
from services.recordings.stream import RecordingError, StoredMessage, messages_of
from services.table import SERVICES

#: Topics that can be replayed, in the order of publication within a tick. Commands to a robot are
#: never replayed.
REPLAYABLE: Final = {
    topic.name: topic
    for topic in (
        *(topics.CAMERA_INFO, topics.ODOMETRY, topics.IMU, topics.POSE, topics.JPEG),
        *(topics.EPISODE, topics.APPLIED),
    )
    if topic in SERVICES["robot"].gives
}


class Tick(NamedTuple):
    """The messages of one tick."""

    number: int  # As in the recording.
    since_s: float  # Time since the first tick.
    messages: tuple[Message, ...]  # In the order of their publication.


@dataclass(eq=False)
class Track:
    """The messages of a robot in one episode; the ids are those of the recording."""

    robot: str
    episode: str
    bad: int = 0  # Number of undecodable messages; they are left out.
    _told: defaultdict[int, list[StoredMessage]] = field(default_factory=lambda: defaultdict(list))

    def __len__(self) -> int:
        return len(self._told)

    def add(self, stored: StoredMessage) -> None:
        """Take a message."""
        self._told[stored.tick].append(stored)

    def play(
        self, robot: str, episode: str, began_ns: int, wanted: Mapping[str, Topic]
    ) -> Iterator[Tick]:
        """Yield the selected topics tick by tick, under other ids.

        The episode is announced as a run, so that a recorder does not create a second
        demonstration. The
        first tick has the stamp `began_ns`; the time between ticks is as recorded.
        """
        first_ns = min(told[0].stamp_ns for told in self._told.values())
        for tick, told in sorted(self._told.items()):
            since_ns = told[0].stamp_ns - first_ns
            header = {"robot": robot, "episode": episode, "stamp_ns": began_ns + since_ns}
            said = sorted(
                (one for stored in told for one in self._said(stored, wanted)), key=_place
            )
            run = header | {"purpose": "run"}
            told_anew = (
                one.model_copy(update=run if isinstance(one, Episode) else header) for one in said
            )
            yield Tick(tick, since_ns / 1e9, tuple(told_anew))

    def _said(self, stored: StoredMessage, wanted: Mapping[str, Topic]) -> Iterator[Message]:
        if stored.topic not in wanted.values():
            return
        try:
            yield stored.message(pixels=True)
        except ValueError:
            self.bad += 1


def _place(message: Message) -> tuple[int, int]:
    """Return the position of a message within its tick: `started` first, `ended` last."""
    order = [*REPLAYABLE].index(message.topic_name)
    if isinstance(message, Episode):
        return {"started": -1, "ended": len(REPLAYABLE)}.get(message.event, order), place_of(
            message
        )
    return order, place_of(message)


def end_of(last: Message, started: Episode) -> Episode:
    """Return an end for an episode whose end is not recorded or not replayed."""
    told = started.model_dump(include={"purpose", "driver", "world", "seed", "goal"})
    return Episode.after(last, event="ended", outcome="aborted", **told)


def tracks_of(path: Path) -> tuple[Track, ...]:
    """Read the messages of robots by episode; raise RecordingError if there are no messages."""
    tracks: dict[tuple[str, str], Track] = {}
    for stored in messages_of(path, REPLAYABLE.values()):
        ids = stored.robot, stored.episode
        tracks.setdefault(ids, Track(*ids)).add(stored)
    if not tracks:
        raise RecordingError(f"{path}: no robot messages in this recording")
    return tuple(tracks.values())

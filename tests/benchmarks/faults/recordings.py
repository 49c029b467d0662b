"""What recordings have, beside what an observer saw: lost, recorded twice, missing and not said so."""

from __future__ import annotations

import json
import struct
from collections import defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any, Final

from mcap.exceptions import McapError
from mcap.reader import make_reader
from mcap.records import Channel, Message, Metadata
from mcap.stream_reader import StreamReader

from schemas.topics import APPLIED, EPISODE, JPEG, POSE, TOPICS, topic_of
from services.recordings.sink import PARTIAL_SUFFIX
from services.recordings.writer import GAPS_METADATA
from tests.benchmarks.faults.log import Order, order_of
from tests.benchmarks.faults.track import Track

#: What the robot sends for every frame, so that a missing one is known although nobody saw it.
FROM_THE_ROBOT: Final = (JPEG.name, POSE.name, APPLIED.name)
Place = tuple[str, Order]


@dataclass
class Recorded:
    """All that was recorded of one episode, in one file or several.

    Parameters
    ----------
    files : list of str
    unfinished : list of str
        Those of them that have no index, or not their final name.
    places : set
        Of all messages.
    duplicates : int
        How many messages are in a file that were there already; a recorder that was killed begins a new one.
    gaps : dict of str to set of int
        Ticks that the files say are missing, by topic.
    """

    files: list[str] = field(default_factory=list)
    unfinished: list[str] = field(default_factory=list)
    places: set[Place] = field(default_factory=set)
    duplicates: int = 0
    gaps: defaultdict[str, set[int]] = field(default_factory=lambda: defaultdict(set))


def read_recordings(folder: Path) -> dict[str, Recorded]:
    """Read all recordings of a folder with the reader of the ``mcap`` package; unfinished ones as far as they go."""
    found: defaultdict[str, Recorded] = defaultdict(Recorded)
    for path in sorted([*folder.glob("*.mcap"), *folder.glob(f"*.mcap{PARTIAL_SUFFIX}*")]):
        with path.open("rb") as file:
            _read(file, path, found)
    return dict(found)


def _read(file: IO[bytes], path: Path, found: defaultdict[str, Recorded]) -> None:
    episodes: set[str] = set()
    gaps: list[Metadata] = []
    finished = PARTIAL_SUFFIX not in path.name
    try:
        reader = make_reader(file)
        gaps = [one for one in reader.iter_metadata() if one.name == GAPS_METADATA]
        messages: Iterator[tuple[Channel, Message]] = ((c, m) for _, c, m in reader.iter_messages(log_time_order=False))
        episodes |= _count(messages, found)
    except (McapError, struct.error, ValueError):
        finished = False
        file.seek(0)
        episodes |= _count(_as_far_as_it_goes(file), found)
    for episode in episodes:
        found[episode].files.append(path.name)
        found[episode].unfinished += [] if finished else [path.name]
        for one in gaps:
            for topic, ticks in one.metadata.items():
                if topic in TOPICS:
                    found[episode].gaps[topic] |= ticks_of(ticks)


def _as_far_as_it_goes(file: IO[bytes]) -> Iterator[tuple[Channel, Message]]:
    channels: dict[int, Channel] = {}
    try:
        for record in StreamReader(file).records:
            if isinstance(record, Channel):
                channels[record.id] = record
            elif isinstance(record, Message):
                yield channels[record.channel_id], record
    except (McapError, struct.error, ValueError):
        return


def _count(messages: Iterable[tuple[Channel, Message]], found: defaultdict[str, Recorded]) -> set[str]:
    own: set[tuple[str, Place]] = set()
    for channel, message in messages:
        topic = topic_of(channel.topic)
        if topic is not None:
            # Only images are not JSON; one belongs to each tick.
            told: dict[str, Any] = json.loads(message.data) if channel.message_encoding == "json" else {}
            kept = topic.name.startswith("command") or topic is EPISODE
            order = order_of(message.sequence, told if kept else {})
            episode = channel.metadata["episode"]
            place = topic.name, order
            found[episode].duplicates += (episode, place) in own
            found[episode].places.add(place)
            own.add((episode, place))
    return {episode for episode, _ in own}


def ticks_of(text: str) -> set[int]:
    """Read ticks as the recorder writes them, for example ``3-5 9``."""
    ticks: set[int] = set()
    for part in text.split():
        first, _, last = part.partition("-")
        ticks.update(range(int(first), int(last or first) + 1))
    return ticks


@dataclass(frozen=True)
class Balance:
    """What an episode's recording lacks, or has too much of.

    Parameters
    ----------
    published : int
        Messages that were published, as far as the observer or the recording shows.
    lost : dict of str to list of int
        Ticks of messages that were published and are not recorded, by topic.
    duplicates : int
    unsaid : dict of str to list of int
        Those of the lost ticks of camera and pose that the recording does not name as a gap.
    """

    published: int
    lost: dict[str, list[int]]
    duplicates: int
    unsaid: dict[str, list[int]]

    @property
    def lost_ticks(self) -> int:
        """How many ticks lack something."""
        return len({tick for ticks in self.lost.values() for tick in ticks})


def balance(track: Track, recorded: Recorded) -> Balance:
    """Compare what was published with what was recorded."""
    published = _published(track, recorded)
    lost: defaultdict[str, set[int]] = defaultdict(set)
    for topic, order in published:
        if (topic, order) not in recorded.places:
            lost[topic].add(int(order[0]))
    unsaid = {topic: _unsaid(topic, lost[topic], recorded) for topic in (JPEG.name, POSE.name) if topic in lost}
    unsaid = {topic: ticks for topic, ticks in unsaid.items() if ticks}
    return Balance(
        len(published), {topic: sorted(ticks) for topic, ticks in sorted(lost.items())}, recorded.duplicates, unsaid
    )


def _unsaid(topic: str, lost: set[int], recorded: Recorded) -> list[int]:
    """Return the lost ticks that a reader is not told of; that a recording without an end was cut is plain to see."""
    if not any(name == EPISODE.name and "ended" in order for name, order in recorded.places):
        last = max((int(order[0]) for name, order in recorded.places if name == topic), default=-1)
        lost = {tick for tick in lost if tick < last}
    return sorted(lost - recorded.gaps.get(topic, set()))


def _published(track: Track, recorded: Recorded) -> set[Place]:
    """Return all messages of recorded topics that there were: seen by the observer, recorded, or of a known frame."""
    seen: set[Place] = {(topic, order) for topic, of_it in track.topics.items() for order in of_it}
    seen |= recorded.places
    seen = {(topic, order) for topic, order in seen if TOPICS[topic].recorded}
    last = {name: max((int(o[0]) for t, o in seen if t == name), default=-1) for name in FROM_THE_ROBOT}
    for name in (JPEG.name, POSE.name):
        seen |= {(name, (tick,)) for tick in range(last[name] + 1)}
    return seen | {(APPLIED.name, (tick, 0)) for tick in range(1, last[APPLIED.name] + 1)}

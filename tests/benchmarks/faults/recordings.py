"""What recordings have, beside what was observed: lost, recorded twice, missing and not said so."""

import json
import struct
from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from typing import Any, Final

from mcap.exceptions import McapError
from mcap.reader import make_reader

from schemas.topics import APPLIED, EPISODE, JPEG, POSE, TOPICS, topic_of
from services.recordings.sink import PARTIAL_SUFFIX
from services.recordings.writer import GAPS_METADATA
from tests.benchmarks.faults.judge import Entry

#: What the robot sends for every frame, from which number on: a missing one is known although nobody saw it.
_FROM_THE_ROBOT: Final = {JPEG.name: 0, POSE.name: 0, APPLIED.name: 1}
Place = tuple[str, int, str]  # Topic, tick, and what tells apart the messages of one tick.


@dataclass
class Recorded:
    """All that was recorded of one episode: places of messages, gaps that are told, files without an end."""

    places: set[Place] = field(default_factory=set)
    duplicates: int = 0
    gaps: defaultdict[str, set[int]] = field(default_factory=lambda: defaultdict(set))
    unfinished: list[str] = field(default_factory=list)
    ended: bool = False  # Whether the end of the episode is there; that a recording without it was cut is plain to see.


def place_of(topic: str, tick: int, told: dict[str, Any]) -> Place:
    """Return a message's place: several events or commands may belong to one tick."""
    several = topic.startswith("command") or topic == EPISODE.name
    return topic, tick, f"{told.get('sequence', '')}{told.get('event', '')}" if several else ""


def read_recordings(folder: Path) -> dict[str, Recorded]:
    """Read all recordings of a folder, by episode, with the ``mcap`` package; "" has the unreadable files."""
    found: defaultdict[str, Recorded] = defaultdict(Recorded)
    for path in sorted([*folder.glob("*.mcap"), *folder.glob(f"*.mcap{PARTIAL_SUFFIX}*")]):
        try:
            _read(path, found)
        except (McapError, struct.error, ValueError):
            found[""].unfinished.append(path.name)
    return dict(found)


def _read(path: Path, found: defaultdict[str, Recorded]) -> None:
    """Add a file to the episodes; its places count once it was read whole."""
    own: defaultdict[str, set[Place]] = defaultdict(set)
    with path.open("rb") as file:
        reader = make_reader(file)
        gaps = [one.metadata for one in reader.iter_metadata() if one.name == GAPS_METADATA]
        for _, channel, message in reader.iter_messages(log_time_order=False):
            topic = topic_of(channel.topic)
            if topic is None:
                continue
            # Only images are not JSON.
            told = json.loads(message.data) if channel.message_encoding == "json" else {}
            episode = channel.metadata["episode"]
            place = place_of(topic.name, message.sequence, told)
            found[episode].duplicates += place in own[episode]
            found[episode].ended |= told.get("event") == "ended"
            own[episode].add(place)
    for episode, places in own.items():
        one = found[episode]
        one.places |= places
        one.unfinished += [path.name] if PARTIAL_SUFFIX in path.name else []
        for name, ticks in chain(*(gap.items() for gap in gaps)):
            if name in TOPICS:
                one.gaps[name] |= ticks_of(ticks)


def ticks_of(text: str) -> set[int]:
    """Read ticks as the recorder writes them, for example ``3-5 9``."""
    ticks: set[int] = set()
    for part in text.split():
        first, _, last = part.partition("-")
        ticks.update(range(int(first), int(last or first) + 1))
    return ticks


def lost(entries: Iterable[Entry], recorded: Recorded) -> dict[str, list[int]]:
    """Return the ticks of messages of an episode that were published and are not recorded, by topic."""
    published = recorded.places | {place_of(one.topic, one.tick, one.told) for one in entries}
    published = {place for place in published if TOPICS[place[0]].recorded}
    missing: defaultdict[str, set[int]] = defaultdict(set)
    for topic, tick, _ in published - recorded.places:
        missing[topic].add(tick)
    for topic, first in _FROM_THE_ROBOT.items():
        seen = {tick for name, tick, _ in published if name == topic}
        missing[topic] |= set(range(first, max(seen, default=-1) + 1)) - seen
    return {topic: sorted(ticks) for topic, ticks in sorted(missing.items()) if ticks}


def unsaid(missing: dict[str, list[int]], recorded: Recorded) -> dict[str, list[int]]:
    """Return those of the lost ticks of camera and pose that a reader is not told of."""
    found = {}
    for topic in (JPEG.name, POSE.name):
        last = max((tick for name, tick, _ in recorded.places if name == topic), default=-1)
        ticks = [tick for tick in missing.get(topic, []) if recorded.ended or tick < last]
        found[topic] = sorted(set(ticks) - recorded.gaps[topic])
    return {topic: ticks for topic, ticks in found.items() if ticks}

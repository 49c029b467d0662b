"""Which features recordings hold, found without reading more of them than one observation an episode."""

from __future__ import annotations

import struct
from collections.abc import Iterable, Iterator
from pathlib import Path

from mcap.exceptions import McapError
from mcap.records import Channel, Message
from pydantic import ValidationError

from schemas.observation import Observation
from schemas.topics import OBSERVATION, topic_of
from services.kit.errors import UsageError
from services.recordings.records import mapped, records
from smal.features import FeatureSettings


def features_of_recordings(paths: Iterable[Path]) -> FeatureSettings:
    """Return the features that recordings hold; the usual ones if they hold none that this version makes.

    Raises
    ------
    UsageError
        When they hold different ones.
    """
    found: dict[FeatureSettings, Path] = {}
    for path in paths:
        for features in features_in(path):
            found.setdefault(features, path)
    if len(found) > 1:
        each = "; ".join(f"{path} holds {','.join(features.modalities)}" for features, path in found.items())
        raise UsageError(f"the recordings hold different features ({each}): choose with --modalities")
    return next(iter(found), FeatureSettings())


def features_in(path: Path) -> tuple[FeatureSettings, ...]:
    """Return the features in a recording, those of each episode once.

    Not those of another version, and none of a file that cannot be read: reading it says why.
    """
    try:
        found = dict.fromkeys(_settings(observation) for observation in _observations(mapped(path)))
    except (OSError, McapError, ValueError, struct.error):
        return ()
    return tuple(features for features in found if features is not None)


def _settings(observation: Observation) -> FeatureSettings | None:
    """Return the settings that made an observation, with equal weights; None where this version makes other features.

    An observation of version 1 names no modalities: it is known where it has the usual ones.
    """
    try:
        features = FeatureSettings.of(observation.modalities or FeatureSettings().modalities)
    except ValueError:
        return None
    return features if features.fingerprint == observation.fingerprint else None


def _observations(data: memoryview) -> Iterator[Observation]:
    """Yield the first readable observation of every channel: one an episode."""
    waiting: set[int] = set()
    for record in records(data):
        if isinstance(record, Channel):
            if topic_of(record.topic) is OBSERVATION:
                waiting.add(record.id)
        elif isinstance(record, Message) and record.channel_id in waiting:
            try:
                observation = Observation.model_validate_json(bytes(record.data))
            except ValidationError:
                continue
            waiting.remove(record.channel_id)
            yield observation

"""Which features recordings hold, found without reading more of them than one observation an episode."""

from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import cast

from schemas.observation import Observation
from schemas.topics import OBSERVATION
from services.kit.errors import UsageError
from services.recordings.stream import RecordingError, messages_of
from smal.features import FeatureSettings


def features_of_recordings(paths: Iterable[Path]) -> FeatureSettings:
    """Return what features recordings hold, the usual ones if none of this version; UsageError when they differ."""
    found: dict[FeatureSettings, Path] = {}
    for path in paths:
        for features in features_in(path):
            found.setdefault(features, path)
    if len(found) > 1:
        each = "; ".join(f"{path} holds {','.join(features.modalities)}" for features, path in found.items())
        raise UsageError(f"the recordings hold different features ({each}): choose with --modalities")
    return next(iter(found), FeatureSettings())


def features_in(path: Path) -> tuple[FeatureSettings, ...]:
    """Return the features in a recording that this version makes, by each episode's first readable observation."""
    found: dict[tuple[str, str], FeatureSettings | None] = {}
    try:
        for stored in messages_of(path, (OBSERVATION,)):
            ids = stored.robot, stored.episode
            if ids not in found:
                with suppress(ValueError):
                    found[ids] = _settings(cast("Observation", stored.message()))
    except RecordingError:
        return ()
    return tuple(dict.fromkeys(features for features in found.values() if features is not None))


def _settings(observation: Observation) -> FeatureSettings | None:
    """Return the settings that made an observation, with equal weights; None where this version makes other features.

    An observation of version 1 names no modalities: it is known where it has the usual ones.
    """
    try:
        features = FeatureSettings.of(observation.modalities or FeatureSettings().modalities)
    except ValueError:
        return None
    return features if features.fingerprint == observation.fingerprint else None

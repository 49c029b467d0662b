"""What the options of ``smal match`` ask for: a method, and its settings where they are not its own."""

from __future__ import annotations

from services.cli.feature_options import parse_features, with_weights
from services.kit.errors import UsageError
from smal.features import FeatureSettings
from smal.place_recognition.methods import METHODS, MatchSettings, Method


def choose(
    name: str, length: int | None, modalities: str | None, weights: str | None, penalty: float | None
) -> tuple[Method, MatchSettings]:
    """Take a method of the table, and its own settings where nothing is asked for.

    Raises
    ------
    UsageError
        When there is no such method, or it does not work with that setting.
    """
    if name not in METHODS:
        raise UsageError(f"--method {name}: unknown; known are {', '.join(METHODS)}")
    method = METHODS[name]
    features = _features(name, method, modalities, weights)
    if length not in (None, method.length) and not method.any_length:
        raise UsageError(f"--length {length}: the method {name} is made for {method.length}")
    chosen = MatchSettings(features, method.length if length is None else length, _penalty(name, method, penalty))
    return method, chosen


def _penalty(name: str, method: Method, penalty: float | None) -> float | None:
    if penalty is None:
        return method.penalty
    if method.penalty is None:
        raise UsageError(f"--penalty {penalty:g}: the method {name} has none")
    if not 0.0 < penalty < 1.0:
        raise UsageError(f"--penalty {penalty:g}: must be above 0 and below 1")
    return penalty


def _features(name: str, method: Method, modalities: str | None, weights: str | None) -> FeatureSettings:
    if not method.any_features and (modalities is not None or weights is not None):
        flag = f"--modalities {modalities}" if modalities is not None else f"--weights {weights}"
        raise UsageError(f"{flag}: the method {name} has its own features, {', '.join(method.features.modalities)}")
    if modalities is not None:
        return parse_features(modalities, weights)
    return method.features if weights is None else with_weights(method.features, weights)

"""What a command may say of the features that it records, learns or runs with."""

from __future__ import annotations

from typing import Annotated

import typer

from services.kit.errors import UsageError
from smal.features import MODALITY_NAMES, FeatureSettings

_NAMES = f"Feature modalities, separated by commas, out of {', '.join(MODALITY_NAMES)}."

Modalities = Annotated[str | None, typer.Option("--modalities", metavar="NAMES", help=f"{_NAMES} [default: color,hog]")]
ModalitiesOrOfModel = Annotated[
    str | None,
    typer.Option("--modalities", metavar="NAMES", help=f"{_NAMES} [default: the model's, or color,hog]"),
]
ModalitiesOfRecordings = Annotated[
    str | None,
    typer.Option("--modalities", metavar="NAMES", help=f"{_NAMES} [default: what the recordings hold]"),
]
Weights = Annotated[
    str | None,
    typer.Option(metavar="NUMBERS", help="How much each modality counts, in their order. [default: all the same]"),
]


def parse_features(modalities: str, weights: str | None = None) -> FeatureSettings:
    """Read ``--modalities``, and ``--weights`` in the same order.

    Raises
    ------
    UsageError
        When a modality is unknown or named twice, the file of a network cannot be used, or the weights do not fit.
    """
    try:
        features = FeatureSettings.parse(modalities)
    except ValueError as error:
        raise UsageError(f"--modalities {modalities}: {error}") from None
    return features if weights is None else with_weights(features, weights)


def with_weights(features: FeatureSettings, weights: str) -> FeatureSettings:
    """Give ``--weights`` to modalities.

    Raises
    ------
    UsageError
        When they are no positive numbers, or not as many as the modalities.
    """
    try:
        return FeatureSettings.parse(features.text, weights)
    except ValueError as error:
        raise UsageError(f"--weights {weights}: {error}") from None


def features_of_own_stack(modalities: str | None, connect: str | None) -> FeatureSettings:
    """Read the modalities of a command that starts a stack of its own unless it connects to another.

    Raises
    ------
    UsageError
        When one is unknown or named twice, or they belong to a stack that runs already.
    """
    if modalities is None:
        return FeatureSettings()
    if connect is not None:
        raise UsageError("--modalities: with --connect the running stack's features count; give it to `smal up`")
    return parse_features(modalities)


def features_for_model(modalities: str | None, model: FeatureSettings | None) -> FeatureSettings:
    """Return what a stack extracts that may have a model from the start.

    Raises
    ------
    UsageError
        When the modalities are not those that the model was learned on.
    """
    if modalities is None:
        return model or FeatureSettings()
    features = parse_features(modalities)
    if model is not None and model.fingerprint != features.fingerprint:
        raise UsageError(f"--modalities {modalities}: the model was learned on {','.join(model.modalities)}")
    return features


def feature_flags(features: FeatureSettings) -> tuple[str, ...]:
    """Return the flags of the features service.

    Raises
    ------
    UsageError
        When a model names a network whose file the user has not given: what a model says makes nothing run.
    """
    try:
        return "--modalities", features.text
    except ValueError as error:
        raise UsageError(f"the model was learned on {','.join(features.modalities)}: {error} (--modalities)") from None

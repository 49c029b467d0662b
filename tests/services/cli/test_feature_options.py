"""What commands say of the features of the stack that they start or use."""

from __future__ import annotations

from pathlib import Path

import pytest

from services.cli.episodes.client import EpisodeClient
from services.cli.feature_options import feature_flags, features_for_model
from services.cli.run import _check_features
from services.features.service import FeaturesService
from services.kit.errors import JobError, UsageError
from services.kit.node import Node
from services.kit.settings import ServiceSettings
from smal.features import FeatureSettings
from tests.services.conftest import RunNode

PLAIN = FeatureSettings()
ALL = FeatureSettings.of(("color", "hog", "depth"))


def test_what_a_model_says_makes_no_network_run(tmp_path: Path) -> None:
    named = FeatureSettings.of(("color", f"onnx:{'ab' * 32}:4"))
    with pytest.raises(UsageError) as caught:
        feature_flags(features_for_model(None, named))
    assert str(caught.value) == (
        f"the model was learned on color,onnx:{'ab' * 32}:4: the network onnx:{'ab' * 32}:4 is run only where its file "
        "is given, as onnx:FILE (--modalities)"
    )
    onnx = pytest.importorskip("tests.smal.test_onnx_features", exc_type=ImportError)
    text = f"color,{onnx.network(tmp_path / 'mix.onnx')}"
    learned_on = FeatureSettings.parse(text)
    assert feature_flags(features_for_model(text, learned_on)) == ("--modalities", text)
    with pytest.raises(UsageError, match=r"the model was learned on color,onnx:abab"):
        features_for_model(text, named)


def test_a_stack_with_a_model_has_the_features_of_the_model() -> None:
    heavy = FeatureSettings(ALL.modalities, (1.0, 1.0, 3.0))
    assert features_for_model(None, None) == PLAIN
    assert features_for_model(None, heavy) == heavy
    assert features_for_model("color,hog,depth", heavy) == ALL
    assert features_for_model("depth", None) == FeatureSettings.of(["depth"])
    with pytest.raises(UsageError, match=r"^--modalities color,hog: the model was learned on color,hog,depth$"):
        features_for_model("color,hog", heavy)
    with pytest.raises(UsageError, match=r"^--modalities smell: unknown feature modality 'smell'"):
        features_for_model("smell", heavy)


def test_a_model_of_other_features_is_an_error_before_the_first_run(
    settings: ServiceSettings, run_node: RunNode
) -> None:
    node = Node("features", settings)
    node.detail = FeaturesService(PLAIN).detail
    run_node(node)
    client = EpisodeClient("test", settings)
    client.node.bus.wait_connected(5.0)
    try:
        _check_features(client, FeatureSettings(PLAIN.modalities, (1.0, 2.0)))
        with pytest.raises(JobError) as caught:
            _check_features(client, ALL)
    finally:
        client.close()
    assert str(caught.value) == (
        "the model was learned on the features color,hog,depth, and the stack makes color,hog; "
        "start it with `smal up --modalities color,hog,depth`"
    )

"""``smal learn --modalities``: from which features of the recorded images a model is learned."""

from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from schemas.array import Float32Array
from schemas.observation import Observation
from services.cli.learn import learn
from services.cli.lessons import Lessons
from services.cli.paper import Settings
from services.cli.paper import learn as learn_paper
from services.kit.errors import UsageError
from smal.features import FeatureSettings
from smal.model import Model
from tests.services.cli.test_learn import drive, teach
from tests.services.recordings.test_recorder_files import record


@pytest.mark.parametrize("command", [learn, partial(learn_paper, settings=Settings())])
def test_learning_refuses_depth_in_one_line(tmp_path: Path, command: Callable[..., None]) -> None:
    path = record(tmp_path, drive("e"))
    depth = FeatureSettings.of(("hog", "depth"))
    with pytest.raises(UsageError) as caught:
        command(lessons=Lessons([path], tmp_path / "model.smal", depth))
    why = "recordings contain no depth images; omit depth"
    assert str(caught.value) == f"features hog,depth: {why}"


def test_learning_ignores_features_of_old_recordings(tmp_path: Path) -> None:
    """Old recordings hold features. Learning computes features from the images."""
    began, *sent = drive("e")
    vector = Float32Array.from_numpy(np.ones(3, np.float32))
    old = [
        Observation.after(m, fingerprint="0123456789ab", modalities=("hog",), features=vector)
        for m in sent
        if m.topic_name == "camera/jpeg"
    ]
    path = record(tmp_path, [began, *old, *sent])
    learn(lessons=Lessons([path], tmp_path / "model.smal"))
    assert Model.load(tmp_path / "model.smal").feature_settings == FeatureSettings()
    assert teach(path).teaching.remarks == []


def test_a_recording_teaches_any_features_of_its_images(tmp_path: Path) -> None:
    wanted = FeatureSettings.of(("thumbnail", "gist"))
    path = record(tmp_path, drive("e"))
    (one,) = teach(path, features=wanted).teaching.demonstrations
    assert one.rows.shape == (40, wanted.size)

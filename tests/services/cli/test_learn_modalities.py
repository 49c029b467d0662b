"""``smal learn --modalities``: from which of the recorded features a model is learned."""

from functools import partial
from pathlib import Path

import pytest

from services.cli.learn import learn as learn_map
from services.cli.lessons import Lessons
from services.cli.paper import Settings, learn
from services.kit.errors import JobError, UsageError
from smal.features import FeatureSettings
from smal.model import Model
from smal.paper.model import PaperModel
from tests.services.cli.test_learn import drive as drive_with
from tests.services.cli.test_learn import teach
from tests.services.recordings.test_recorder_files import record

FEATURES = FeatureSettings()
ALL = FeatureSettings.of(("color", "hog", "depth"))
drive = partial(drive_with, features=FEATURES, frames=16)


def taught(recordings: Path, out: Path, features: FeatureSettings | None = None) -> None:
    """Learn by the paper's scheme."""
    learn(lessons=Lessons([recordings], out, features), settings=Settings())


@pytest.fixture
def with_depth(tmp_path: Path) -> Path:
    folder = tmp_path / "drives"
    folder.mkdir()
    for number in range(2):
        record(folder, drive(f"drive-{number}", features=ALL))
    return folder


def test_depth_is_in_no_image(with_depth: Path, tmp_path: Path) -> None:
    path = record(tmp_path, drive("plain"))
    teaching = teach(path, features=ALL).teaching
    reason = "it lacks the features color,hog,depth, and no image has the depth for them"
    line = f"{path}: episode plain is left out: {reason}"
    assert (teaching.demonstrations, teaching.remarks) == ([], [line])
    with pytest.raises(JobError, match="it lacks the features depth, and no image has"):
        taught(path, tmp_path / "model.smal", FeatureSettings.of(("depth",)))
    mixed = teach(with_depth, path, features=ALL).teaching
    assert (len(mixed.demonstrations), mixed.remarks) == (2, [line])


def test_recordings_with_different_features_need_a_choice(with_depth: Path, tmp_path: Path) -> None:
    path = record(with_depth, drive("plain"))
    with pytest.raises(UsageError) as caught:
        taught(with_depth, tmp_path / "model.smal")
    assert "\n" not in str(caught.value)
    for part in (
        f"{with_depth}/drive-0.mcap holds color,hog,depth",
        f"{path} holds color,hog)",
        "with --modalities",
    ):
        assert part in str(caught.value)
    taught(with_depth, tmp_path / "model.smal", FeatureSettings())
    assert len(PaperModel.load(tmp_path / "model.smal").names) == 3


def test_a_map_has_no_depth(tmp_path: Path) -> None:
    """It is refused where it is asked for, and left out where it is only recorded."""
    features = FeatureSettings.of(("thumbnail", "depth"))
    out = tmp_path / "model.smal"
    path = record(tmp_path, drive("drive-0", features=features))
    with pytest.raises(UsageError) as caught:
        learn_map(lessons=Lessons([path], out, features))
    said = "a map of views has no depth; leave depth out, or use `smal paper learn`"
    assert str(caught.value) == f"--modalities thumbnail,depth: {said}"
    learn_map(lessons=Lessons([path], out))
    assert Model.load(out).feature_settings == FeatureSettings(("thumbnail",))
    # Where nothing else was recorded the usual features are computed from the images.
    path = record(tmp_path, drive("drive-1", features=FeatureSettings.of(("depth",))))
    learn_map(lessons=Lessons([path], out))
    assert Model.load(out).feature_settings == FEATURES

"""``smal learn --modalities``: from which of the recorded features a model is learned."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from services.cli import learn as learning
from services.kit.errors import JobError, UsageError
from services.recordings.recorded_features import features_in, features_of_recordings
from smal.features import FeatureSettings, extract
from smal.model import Model
from smal.paper.model import Model as PaperModel
from tests.services.cli.test_learn import depth, teach, view
from tests.services.cli.test_learn import drive as drive_with
from tests.services.recordings.test_recorder_files import leave, record

FEATURES = FeatureSettings()
ALL = FeatureSettings.of(("color", "hog", "depth"))
drive = partial(drive_with, features=FEATURES)
#: A map of views takes seconds with these features; ``test_learn`` has it.
learn = partial(learning.learn, scheme="paper")


@pytest.fixture
def with_depth(tmp_path: Path) -> Path:
    folder = tmp_path / "drives"
    folder.mkdir()
    for number in range(2):
        record(folder, drive(f"drive-{number}", features=ALL))
    return folder


def test_without_a_choice_the_recordings_decide(with_depth: Path, tmp_path: Path) -> None:
    out, report = tmp_path / "model.smal", tmp_path / "report.json"
    learn([with_depth], out, json_file=report)
    assert PaperModel.load(out).feature_settings == ALL
    said = json.loads(report.read_text())
    assert (said["modalities"], said["weights"]) == (["color", "hog", "depth"], [1.0, 1.0, 1.0])
    assert said["remarks"] == []


@pytest.mark.parametrize("names", ["color,hog", "depth", "hog,depth", "depth,color"])
def test_any_of_the_recorded_modalities_can_be_learned_from(with_depth: Path, names: str) -> None:
    wanted = FeatureSettings.parse(names)
    teaching = teach(with_depth, features=wanted).teaching
    assert teaching.remarks == []
    for one in teaching.demonstrations:
        expected = np.stack([extract(view(tick), wanted, depth(tick)) for tick in range(40)])
        np.testing.assert_array_equal(one.features, expected)


def test_weights_go_with_the_modalities_in_their_order(
    with_depth: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "model.smal"
    learn([with_depth], out, modalities=FeatureSettings.of(("depth", "hog")), weights="3,1")
    assert PaperModel.load(out).feature_settings == FeatureSettings(("depth", "hog"), (3.0, 1.0))
    assert "features        depth (weight 3) hog (weight 1)\n" in capsys.readouterr().out
    learn([with_depth], out, weights="1,1,2")
    model = PaperModel.load(out)
    assert model.feature_settings == FeatureSettings(ALL.modalities, (1.0, 1.0, 2.0))
    shares = [np.square(model.templates[where]).sum(axis=0) for where in ALL.slices]
    np.testing.assert_allclose(shares[2] / shares[0], 4.0, rtol=1e-3)


def test_depth_is_in_no_image(with_depth: Path, tmp_path: Path) -> None:
    path = record(tmp_path, drive("plain"))
    teaching = teach(path, features=ALL).teaching
    reason = "it lacks the features color,hog,depth, and no image has the depth for them"
    line = f"{path}: episode plain is left out: {reason}"
    assert (teaching.demonstrations, teaching.remarks) == ([], [line])
    with pytest.raises(JobError, match="it lacks the features depth, and no image has"):
        learn([path], tmp_path / "model.smal", modalities=FeatureSettings.of(("depth",)))
    mixed = teach(with_depth, path, features=ALL).teaching
    assert (len(mixed.demonstrations), mixed.remarks) == (2, [line])


def test_recordings_with_different_features_need_a_choice(with_depth: Path, tmp_path: Path) -> None:
    path = record(with_depth, drive("plain"))
    with pytest.raises(UsageError) as caught:
        learn([with_depth], tmp_path / "model.smal")
    assert "\n" not in str(caught.value)
    for part in (f"{with_depth}/drive-0.mcap holds color,hog,depth", f"{path} holds color,hog)", "with --modalities"):
        assert part in str(caught.value)
    learn([with_depth], tmp_path / "model.smal", modalities=FeatureSettings())
    assert len(PaperModel.load(tmp_path / "model.smal").names) == 3


def test_a_map_has_no_depth(tmp_path: Path) -> None:
    """It is refused where it is asked for, and left out where it is only recorded."""
    features, out = FeatureSettings.of(("thumbnail", "depth")), tmp_path / "model.smal"
    path = record(tmp_path, drive("drive-0", features=features))
    with pytest.raises(UsageError) as caught:
        learning.learn([path], out, modalities=features)
    said = "a map of views has no depth; leave depth out, or give --scheme paper"
    assert str(caught.value) == f"--modalities thumbnail,depth: {said}"
    learning.learn([path], out)
    assert Model.load(out).feature_settings == FeatureSettings(("thumbnail",), (1.0,))
    with pytest.raises(UsageError, match=r"^--weights 1,2: 1 modalities need as many weights, got 2"):
        learning.learn([path], out, weights="1,2")
    # Where nothing else was recorded the usual features are computed from the images.
    path = record(tmp_path, drive("drive-1", features=FeatureSettings.of(("depth",))))
    assert learning._features([path], "filter", None, None) == FEATURES


def test_what_says_nothing_of_its_features_leaves_the_usual_ones(tmp_path: Path) -> None:
    old = record(tmp_path, drive("old", fingerprint="00000000ffff"))
    foreign, empty = tmp_path / "foreign.mcap", tmp_path / "empty.mcap"
    foreign.write_bytes(b"not a recording")
    empty.write_bytes(b"")
    paths = [old, foreign, empty, tmp_path / "none.mcap"]
    assert [features_in(path) for path in paths] == [()] * 4
    assert features_of_recordings(paths) == FEATURES
    whole = record(tmp_path, drive("whole", features=ALL))
    assert features_of_recordings([*paths, whole]) == ALL
    left = leave(tmp_path, drive("left", features=ALL)[:-1])
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(whole.read_bytes()[: whole.stat().st_size // 2])
    assert features_in(cut) == features_in(left) == (ALL,)

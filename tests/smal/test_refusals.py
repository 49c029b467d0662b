"""Input to the library that is invalid raises a ValueError whose one line names it."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

import smal
from smal.camera import Camera
from smal.evaluation.ground_truth import Judgement
from smal.evaluation.precision_recall import PrecisionRecall, bootstrap
from smal.features import Centering, FeatureSettings, extract, select
from smal.features.modalities import MODALITY_NAMES
from smal.obstacles.ground import Ground
from smal.paper.action_space import learn_action_space
from smal.paper.learning import LearningSettings, learn
from smal.paper.objective import s1_norm
from smal.paper.policy import policy_iteration
from smal.paper.reward import learn_reward
from smal.paper.transitions import learn_transitions
from smal.place_recognition.matches import check_features
from smal.teaching.demonstration import Demonstration
from tests.smal.worlds import COLOR, corridor, drive, matching_problem

NAN = np.nan
INF = np.inf
USUAL = FeatureSettings()
WITH_DEPTH = FeatureSettings.of(("color", "hog", "depth"))
FRAME = np.zeros((48, 64, 3), np.uint8)
RAW = extract(FRAME, USUAL)
CENTERING = Centering(np.zeros(USUAL.size, np.float32), USUAL)
FEATURES = np.ones((4, 3), np.float32)
ROWS = np.zeros((3, 5))
DRIVE = drive(corridor(24), 0, seed=0)
NOTHING = Judgement(
    np.zeros(3), np.ones(3, bool), np.zeros(3, bool), np.ones(3, bool), np.zeros(3, bool)
)
TRANSITIONS = learn_transitions([np.array([0, 1, 2], np.int32)], [np.zeros(3, np.int32)], [True], 3)


def ints(*values: int) -> np.ndarray:
    return np.array(values, np.int32)


def broken(value: float) -> np.ndarray:
    return np.where(np.arange(12).reshape(4, 3) == 7, np.float32(value), FEATURES)


def solve(**change: object) -> object:
    X, Y = matching_problem(0, blocks=3, length=2)
    usual = {"templates": X, "query": Y, "sequence_length": 2, "lambda1": 0.1, "lambda2": 0.1}
    return smal.solve(**usual | change)


def with_depth(depth: np.ndarray | None) -> object:
    return extract(FRAME, WITH_DEPTH, depth)


def taught(**setting: object) -> LearningSettings:
    return LearningSettings(features=COLOR, **setting)


@pytest.mark.parametrize(
    ("use", "words"),
    [
        (lambda: Camera(NAN), "focal length"),
        (lambda: Camera(0.0), "focal length"),
        (lambda: Camera(0.5, "ftheta"), "ftheta"),
        (lambda: Camera(0.5, distortion=(INF,)), "distortion"),
        (lambda: Camera(0.5, distortion=(0.0,) * 14), "distortion"),
        (lambda: with_depth(None), "the features color, hog, depth need a depth image"),
        (lambda: with_depth(np.ones((24, 32), np.float32)), "uint16 in millimetres, got float32"),
        (
            lambda: with_depth(np.ones((24, 32, 1), np.uint16)),
            r"\(height, width\), got \(24, 32, 1",
        ),
        (lambda: with_depth(np.ones((0, 32), np.uint16)), "shape"),
        (lambda: extract(FRAME.astype(np.float32), USUAL), "uint8"),
        (lambda: extract(FRAME[..., 0], USUAL), "shape"),
        (lambda: extract(np.zeros((48, 64, 4), np.uint8), USUAL), "shape"),
        (lambda: extract(FRAME[:23], USUAL), "at least 24 rows"),
        (lambda: FeatureSettings(("smell",)), "unknown"),
        (lambda: FeatureSettings((1,)), "unknown"),
        (lambda: FeatureSettings(()), "no feature modality"),
        (lambda: FeatureSettings(("color", "color")), "twice"),
        (lambda: FeatureSettings.parse(""), f"ty ''; known are {', '.join(MODALITY_NAMES)}$"),
        (lambda: FeatureSettings.parse("color,hgo"), "unknown feature modality 'hgo'"),
        (lambda: FeatureSettings.parse("apriltag,qr"), "no feature modality is named that"),
        (lambda: select(RAW, USUAL, WITH_DEPTH), "the features color, hog do not hold depth"),
        (lambda: select(RAW[1:], USUAL, USUAL), "8244 entries"),
        (lambda: CENTERING.apply(np.zeros(7, np.float32)), "8244 entries"),
        (lambda: CENTERING.apply(np.full(USUAL.size, NAN, np.float32)), "NaN"),
        (lambda: Centering(np.zeros(3, np.float32), USUAL), "the mean"),
        (lambda: Centering.fit(np.zeros((0, USUAL.size), np.float32), USUAL), "n >= 1"),
        (lambda: Ground(np.zeros((3, 5, 2), np.uint8), 0.1), "the ground do not fit together"),
        (lambda: check_features(FEATURES, FEATURES[:, :2]), r"\(4, 3\) and \(4, 2\)"),
        (lambda: check_features(FEATURES, FEATURES[0]), r"\(4, 3\) and \(3,\)"),
        (lambda: check_features(FEATURES, broken(NAN)), "queries contain NaN"),
        (lambda: check_features(FEATURES, broken(-INF)), "queries contain NaN"),
        (lambda: check_features(broken(NAN), FEATURES), "references contain NaN"),
        (lambda: check_features(broken(INF), FEATURES), "references contain NaN"),
        (lambda: smal.match(np.zeros((3, 5)), np.zeros((3, 4))), "shapes"),
        (lambda: smal.match(np.full((3, 5), NAN), np.zeros((3, 5))), "NaN"),
        (lambda: smal.match(np.zeros((2, 8, 8, 3), np.uint8)), "at least 24 rows"),
        (lambda: smal.match(np.zeros((3, 5)), method="none"), "unknown method 'none'; known are"),
        (lambda: smal.match(np.zeros((3, 5)), method="paper"), "has no loops"),
        (lambda: smal.match(ROWS, ROWS, method="seqslam"), "has its own features"),
        (lambda: PrecisionRecall.of(NOTHING), "no query has anything to find"),
        (lambda: bootstrap(NOTHING, 1), "no query has anything to find"),
        (lambda: Demonstration("x", DRIVE.features, DRIVE.atoms[:-1]), "do not fit"),
        (lambda: learn([], taught()), "no demonstration"),
        (lambda: learn([DRIVE], LearningSettings()), "settings ask for"),
        (lambda: learn([replace(DRIVE, successful=False)], taught()), "goal"),
        (lambda: taught(sequence_length=0), "sequence_length must be at least 1, got 0"),
        (lambda: taught(lambda1=0.0), "lambda1 must be finite and positive, got 0.0"),
        (lambda: taught(gamma=1.0), "gamma"),
        (lambda: taught(tau=-1.0), "tau must be finite and not negative"),
        (lambda: learn_action_space([np.array([0, 9], np.int8)], 1), "atoms must be"),
        (lambda: learn_action_space([np.array([0, 1], np.int8)], 3), "no demonstration"),
        (lambda: learn_transitions([ints(0, 1)], [ints(0, 0)], [False], 2), "goal"),
        *(
            (use, "gamma")
            for gamma in (-0.1, 1.0, NAN)
            for use in (
                partial(policy_iteration, TRANSITIONS, np.zeros(3), gamma),
                partial(learn_reward, TRANSITIONS, gamma),
            )
        ),
        (lambda: learn_reward(TRANSITIONS, 0.9, sparsity=2.0), "sparsity"),
        (lambda: s1_norm(np.ones((3, 2)), 0), "sequence_length"),
        *(
            (partial(solve, **{name: value}), name)
            for name, values in {
                "sequence_length": (0,),
                "lambda1": (-1.0,),
                "lambda2": (NAN, INF),
                "tolerance": (0.0, 1.0, NAN),
            }.items()
            for value in values
        ),
        (lambda: solve(lambda1=0.0, lambda2=0.0), "not both 0"),
        (lambda: solve(query=np.ones((3, 2), np.float32)), "do not fit"),
        (lambda: solve(query=np.ones(60, np.float32)), "do not fit"),
        (lambda: solve(templates=np.ones(60, np.float32)), "matrix"),
        (lambda: solve(templates=np.ones((60, 0), np.float32)), "at least one template"),
        (lambda: solve(templates=np.ones((60, 2), np.int64)), "floating point"),
    ],
)
def test_library_raises_one_line_when_input_is_invalid(
    use: Callable[[], object], words: str
) -> None:
    with pytest.raises(ValueError, match=words) as caught:
        use()
    assert str(caught.value).isprintable()


def test_features_are_valid_when_there_are_no_queries() -> None:
    check_features(FEATURES, FEATURES[:0])

"""Detectors of tags, QR codes and networks add to the evidence for the target."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest

from smal import Model, Robot, fit
from smal.camera import Image
from smal.features import FeatureSettings
from smal.features.detectors import Detection, qr_codes
from smal.features.extraction import detect
from smal.files.container import ModelError
from smal.target.detector import TargetDetector
from smal.target.learning import Taught, learn_label
from tests import corridor

TAGS = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
READS = FeatureSettings(("color", "apriltag"))
AT_END = 7
BESIDE = 3
OTHER = 8


def view(pose: corridor.Pose, *tags: tuple[int, float, float]) -> Image:
    """Return what a camera sees in the corridor, with tags 0.3 m wide: number, how far along, how far left."""
    picture = corridor.view(*pose, scale=4)
    rows, columns = picture.shape[:2]
    for number, along_m, left_m in tags:
        cos = np.cos(pose[2])
        sin = np.sin(pose[2])
        ahead = (along_m - pose[0]) * cos + (left_m - pose[1]) * sin
        left = (left_m - pose[1]) * cos - (along_m - pose[0]) * sin
        if ahead < 0.5:
            continue
        side = round(0.7 * columns * 0.3 / ahead)
        white = side // 8
        at = round(columns / 2 - 0.7 * columns * left / ahead - side / 2)
        top = rows // 2 - side // 2
        if side > 20 and at > white and at + side + white < columns:
            picture[top - white : top + side + white, at - white : at + side + white] = 255
            picture[top : top + side, at : at + side] = TAGS.generateImageMarker(number, side)[
                ..., None
            ]
    return picture


@cache
def model() -> Model:
    _, atoms, way = corridor.drive()
    return fit(
        [([view(pose, (AT_END, 5.5, 0.0), (BESIDE, 3.2, 0.7)) for pose in way], atoms, way)], READS
    )


@pytest.mark.long
def test_robot_finds_its_tag_and_no_other(
    tmp_path: Path,
) -> None:
    assert model().labels["victim"].label == f"apriltag {AT_END}"
    model().save(tmp_path / "way.smal")
    for number, said in ((AT_END, "found"), (OTHER, "not_here")):
        # By the tag alone: at 80 x 60 pixels two tags look much the same.
        robot = Robot(replace(Model.load(tmp_path / "way.smal"), appearances={}))
        here = (2.4, 0.1, 0.0)
        for _ in range(250):
            here = corridor.moved(here, robot.step(view(here, (number, 5.5, 0.0)), here))
            if robot.done:
                break
        assert robot.said == said


def test_a_tag_adds_to_how_its_place_looks() -> None:
    at_end = corridor.pose(corridor.FRAMES)
    appearance = model().appearances.get("victim")
    label = model().labels["victim"]
    pictures = [view(at_end, (number, 5.5, 0.0)) for number in (AT_END, OTHER)]
    small = [cv2.resize(one, (80, 60), interpolation=cv2.INTER_AREA) for one in pictures]
    right, wrong = (
        TargetDetector(appearance, label).observe(one, 0.0, detect(two, READS))
        for one, two in zip(small, pictures, strict=True)
    )
    assert right.probability > 0.99
    assert right.near == pytest.approx(1.0, abs=0.1)
    assert wrong.probability < TargetDetector(appearance).observe(small[1]).probability
    hidden = np.full_like(small[0], 30)
    assert TargetDetector(appearance, label).observe(hidden) == TargetDetector(appearance).observe(
        hidden
    ), "a hidden view is no evidence"


def test_label_counts_only_when_it_distinguishes_the_end() -> None:
    box = (0.4, 0.4, 0.6, 0.6)

    def learned(*ends: str, scores: float = 1.0, way: float = 0.0) -> str | None:
        """Return the target of drives whose final objects also score on the way."""
        each = [
            [Detection(one, scores if near else way, box) for one in ends]
            for near in [False] * 20 + [True] * 4
        ]
        drive = Taught(
            [np.zeros((60, 80, 3), np.uint8)] * 24,
            np.arange(24.0)[::-1] / 2.0,
            ends=True,
            detected=each,
        )
        label = learn_label([drive])
        return None if label is None else label.label

    assert learned("boxes 3") == "boxes 3"
    assert learned("boxes 3", scores=0.3) == "boxes 3", "no threshold is typed in"
    assert learned("boxes 3", way=0.9) is None, "what is everywhere tells nothing"
    assert learned() is None


def test_qr_text_is_detected() -> None:
    code = cv2.resize(
        cv2.QRCodeEncoder.create().encode("dock 4"), (120, 120), interpolation=cv2.INTER_NEAREST
    )
    picture = np.full((240, 320, 3), 255, np.uint8)
    picture[60:180, 100:220] = code[..., None]
    (found,) = qr_codes(picture)
    assert (found.label, found.score) == ("qr dock 4", 1.0)
    assert found.box == pytest.approx((100 / 320, 60 / 240, 220 / 320, 180 / 240), abs=0.05)


def test_network_draws_boxes_or_is_refused_in_one_line(tmp_path: Path) -> None:
    pytest.importorskip("onnxruntime")
    onnx = pytest.importorskip("onnx")
    helper = onnx.helper
    floats = onnx.TensorProto.FLOAT

    def network(name: str, *shape: int) -> Path:
        """Write a network whose boxes score by how bright the picture is: 16 to 48 of 64 columns, all rows."""
        rows = np.zeros((2, *shape), dtype=np.float32)
        rows[0, ..., :6] = (16, 0, 48, 64, 0, 5)
        rows[1, ..., :6] = (0, 0, 0, 0, 1, 0)
        graph = helper.make_graph(
            [
                helper.make_node("ReduceMean", ["x"], ["mean"], keepdims=0),
                helper.make_node("Mul", ["mean", "score"], ["scored"]),
                helper.make_node("Add", ["scored", "box"], ["boxes"]),
            ],
            "boxes",
            [helper.make_tensor_value_info("x", floats, [1, 3, 64, 64])],
            [helper.make_tensor_value_info("boxes", floats, None)],
            [
                onnx.numpy_helper.from_array(part, what)
                for part, what in zip(rows, ("box", "score"), strict=True)
            ],
        )
        made = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
        onnx.save_model(made, str(tmp_path / name))
        return tmp_path / name

    chosen = FeatureSettings.parse(f"thumbnail,boxes:{network('one.onnx', 1, 1, 6)}")
    assert (chosen.size, chosen.text) == (
        FeatureSettings(("thumbnail",)).size,
        f"thumbnail,boxes:{tmp_path}/one.onnx",
    )
    (found,) = detect(np.full((120, 160, 3), 51, np.uint8), chosen)
    assert found == ("boxes 5", pytest.approx(0.2, abs=1e-6), pytest.approx((0.25, 0.0, 0.75, 1.0)))
    with pytest.raises(
        ValueError,
        match=r"raw.onnx: a detector's first output must be boxes \(1, n, 6\).*\(1, 84, 8\)$",
    ):
        FeatureSettings.parse(f"thumbnail,boxes:{network('raw.onnx', 1, 84, 8)}")


def test_file_is_refused_when_its_detector_does_not_fit(tmp_path: Path) -> None:
    harmed = replace(model().labels["victim"])
    vars(harmed)["size"] = -1.0
    replace(model(), labels={"victim": harmed}).save(tmp_path / "way.smal")
    with pytest.raises(
        ModelError, match="the detector's calibration do not fit together: 'apriltag 7'"
    ):
        Model.load(tmp_path / "way.smal")

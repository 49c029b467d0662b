"""Laps of a car in a painted room, as a tub: they are found, one teaches, others are asked; and hand-made beliefs."""

import json
import math
import shutil
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from services.experiments.laps.asking import judge
from services.experiments.laps.source import read_laps
from services.importers.drive import ImportFailure, Tally
from services.importers.job import ImportJob
from services.importers.run import run
from services.kit.jpeg import encode_jpeg
from smal.keyframes import MapConfig
from smal.teaching.mapping import learn
from tests.services.cli.conftest import Smal
from tests.sharing import made_once
from tests.smal.synthetic_world import COLOR, SCENE, Room

#: Radians a frame in each lap, and how far outside of the usual circle it is, metres.
LAPS = ((0.12, 0.0), (0.125, 0.05), (0.13, 0.02), (0.135, -0.03))
BEGIN_RAD = 0.3


def angles() -> list[tuple[float, float]]:
    """Return where on the circle each frame is, laps counted on, and how far outside."""
    found = []
    angle_rad = BEGIN_RAD
    while (lap := int(angle_rad / math.tau)) < len(LAPS):
        step_rad, outside = LAPS[lap]
        found.append((angle_rad, outside))
        angle_rad += step_rad
    return found


def write_tub(folder: Path) -> None:
    room = Room()
    lines = []
    (folder / "images").mkdir()
    for index, (angle_rad, outside) in enumerate(angles()):
        radius = 2.0 + outside
        name = f"{index}.jpg"
        pose = (6.0 + radius * math.sin(angle_rad), 6.0 - radius * math.cos(angle_rad), angle_rad)
        (folder / "images" / name).write_bytes(encode_jpeg(room.look(pose)))
        record = {
            "_index": index, "_timestamp_ms": 1_700_000_000_000 + 100 * index, "cam/image_array": name,
            "user/angle": -1.0, "user/throttle": 4.0 * LAPS[int(angle_rad / math.tau)][0], "user/mode": "user",
        }  # fmt: skip
        lines.append(json.dumps(record))
    (folder / "catalog_0.catalog").write_text("\n".join(lines) + "\n")
    last = {"paths": ["catalog_0.catalog"], "current_index": len(lines), "deleted_indexes": []}
    (folder / "manifest.json").write_text("\n".join(map(json.dumps, [[], [], {}, {}, last])) + "\n")


@pytest.fixture(scope="module")
def tub(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return made_once(tmp_path_factory, "tub-of-laps", write_tub)


def test_laps_are_aligned_within_2_per_cent(tub: Path) -> None:
    laps = read_laps(tub, lambda *_: None)
    true_rad = np.array(angles())[:, 0]
    assert len(laps) == len(LAPS) - 1
    _, taught = laps[0]
    for drive, lap in laps:
        here_rad = true_rad[lap.first : lap.last]
        shown_rad = true_rad[taught.first + lap.shows]
        off = np.abs(np.remainder(here_rad - shown_rad + math.pi, math.tau) - math.pi) / math.tau
        assert off.max() < 0.02
        assert (lap.last - lap.first) * LAPS[int(here_rad[-1] / math.tau)][0] == pytest.approx(
            math.tau, rel=0.15
        )
        assert drive.odometry[-1, 2] - drive.odometry[0, 2] == pytest.approx(math.tau, rel=0.06)


def test_laps_take_a_frame_rate_when_a_tub_was_copied(tub: Path, tmp_path: Path) -> None:
    copied = shutil.copytree(tub, tmp_path / "tub")
    catalog = copied / "catalog_0.catalog"
    records = [json.loads(line) for line in catalog.read_text().splitlines()]
    lines = (json.dumps(record | {"_timestamp_ms": 1_700_000_000_000}) for record in records)
    catalog.write_text("\n".join(lines))
    with pytest.raises(ImportFailure, match="give the frame rate with --rate"):
        read_laps(copied, lambda *_: None)
    assert len(read_laps(copied, lambda *_: None, 10.0)) == len(LAPS) - 1


@pytest.mark.long
def test_laps_page_shows_recognition_when_one_lap_teaches(
    tub: Path, tmp_path: Path, smal: Smal, monkeypatch: pytest.MonkeyPatch
) -> None:
    job = ImportJob(
        format="donkeycar",
        path=str(tub),
        folder=str(tmp_path),
        robot="car",
        speed=5.0,
        turn_rate=2.5,
    )
    (recording,) = run(job, Tally()).files
    monkeypatch.setattr(
        "services.experiments.laps.asking.learn",
        partial(learn, config=MapConfig(sampled_views=250)),
    )
    for module in ("source", "asking"):
        monkeypatch.setattr(f"services.experiments.laps.{module}.JUDGED", COLOR)
    monkeypatch.setattr("smal.teaching.mapping.fit_camera", lambda *_: SCENE.camera)
    monkeypatch.setattr("smal.teaching.mapping.fit_scene", lambda *_: SCENE)
    status, said, _ = smal("laps", recording, "--out", tmp_path)
    assert (status, said) == (0, f"results: {tmp_path / 'index.html'}\n")
    found = json.loads((tmp_path / "results.json").read_text())
    assert found["laps"] == len(LAPS) - 1
    methods = found["methods"]
    assert set(methods) == {
        "SMAL", "SMAL without odometry", "nearest 1", "nearest 5", "teach and repeat",
    }  # fmt: skip
    assert (
        min(methods[name]["right within a tenth"] for name in ("SMAL", "nearest 1", "nearest 5"))
        > 0.9
    )
    assert methods["SMAL"]["lost"] < 0.1
    low, high = methods["SMAL"]["right within a tenth, 95 %"]
    assert low <= methods["SMAL"]["right within a tenth"] <= high
    assert methods["SMAL"]["calibration error"] < 0.1


def test_figures_are_those_of_hand_made_beliefs() -> None:
    """The lap has 20 frames and is closed."""
    first = np.array([(0, 0.9, 0.0), (2, 0.9, 0.0), (19, 0.9, 0.0), (8, 0.1, 0.05)])
    second = np.array([(9, 0.9, 0.05), (5, 0.1, 0.6), (6, 0.9, 0.0), (7, 0.1, 0.3)])
    found = judge([first, second], [np.array([0, 1, 1, 3]), np.array([4, 5, 6, 17])], 20)
    figures = found.figures
    assert figures["right within a twentieth"] == 4 / 8
    assert figures["right within a tenth"] == 5 / 8
    assert figures["lost"] == 1 / 8
    assert figures["wrong and sure"] == 2 / 8
    # Said .9 five times and right four times, said .1 three times and right once.
    assert figures["calibration error"] == pytest.approx(
        (5 * abs(0.9 - 4 / 5) + 3 * abs(0.1 - 1 / 3)) / 8
    )
    # One lap has three of four within a tenth, the other two: no mean is beyond these.
    assert figures["right within a tenth, 95 %"] == pytest.approx([2 / 4, 3 / 4])
    silent = judge([np.array([(np.nan, np.nan, 0.0), (1, np.nan, 0.0)])], [np.array([0, 1])], 20)
    assert silent.figures == {
        "right within a twentieth": 0.5, "right within a twentieth, 95 %": [0.5, 0.5],
        "right within a tenth": 0.5, "right within a tenth, 95 %": [0.5, 0.5],
    }  # fmt: skip

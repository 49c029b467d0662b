"""The map of taught ways: keyframes, measures of views, and refusals."""

import json
import math
import multiprocessing
import threading
import weakref
from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest

from smal.camera import TURNS_DEG, Camera
from smal.features import extract
from smal.files.packed import unit
from smal.keyframes import MapConfig
from smal.map import VisualMap
from smal.teaching import mapping
from smal.teaching.calibration import CALIBRATION_CONFIG, TaughtFrames, correlation_length
from smal.teaching.demonstration import Demonstration
from tests import corridor
from tests.smal.synthetic_world import COLOR, SCENE, START, Image, Room, drive, taught, usual_map

ROOM = Room()
BEND = ((3.5, 60.0), (2.5, 0.0))
MIDDLE = TURNS_DEG.size // 2


def at_rate(rate_hz: float) -> VisualMap:
    return taught(ROOM, drive(way=BEND, rate_hz=rate_hz), rate_hz=rate_hz, scene=SCENE)[0]


def learn(
    images: Sequence[Sequence[Image]], poses: Sequence[Any], atoms: Sequence[Any]
) -> VisualMap:
    raw = [np.stack([extract(image, COLOR) for image in each]) for each in images]
    drives = [
        Demonstration(
            f"drive-{k}",
            raw[k],
            np.asarray(atoms[k], dtype=np.int8),
            images=images[k],
            odometry=poses[k],
        )
        for k in range(len(images))
    ]
    return mapping.learn(drives, COLOR, 0.1, config=MapConfig(sampled_views=500)).mapped


def test_keyframes_are_spaced_by_correlation_length_and_turn() -> None:
    found = usual_map()[0]
    step = np.abs(np.diff(found.key_poses, axis=0))
    way = np.hypot(step[:, 0], step[:, 1])
    turn = np.degrees(step[:, 2])
    # A frame is 5 cm or 4.5 degrees; the last keyframe is the last frame.
    assert (way <= 0.2 * found.correlation_length + 0.051).all()
    assert (turn <= 12.0 + 4.6).all()
    assert ((way >= 0.2 * found.correlation_length - 1e-9) | (turn >= 12.0 - 1e-9))[:-1].all()


def test_map_is_similar_when_the_frame_rate_differs() -> None:
    usual = at_rate(10.0)
    other = at_rate(5.0)
    # The measured length is no bound of what was looked at.
    assert usual.correlation_length < 0.7
    assert other.correlation_length == pytest.approx(usual.correlation_length, rel=0.15)
    assert other.correlation_rad == pytest.approx(usual.correlation_rad, rel=0.15)
    assert other.likelihood.of(np.array([4.0])) == pytest.approx(
        usual.likelihood.of(np.array([4.0])), abs=1.5
    )
    assert len(other.keyframes) == pytest.approx(len(usual.keyframes), rel=0.25)
    assert other.speed == pytest.approx(usual.speed, rel=1e-6)


def test_view_matches_the_virtual_view_of_its_pose() -> None:
    found, centering = usual_map()
    for key in range(2, len(found.keyframes), 6):
        x, y, heading = found.key_poses[key]
        for column, place in ((0, -found.aside), (1, 0.0), (2, found.aside)):
            for turn in (-20, 0, 20):
                pose = (
                    x - math.sin(heading) * place,
                    y + math.cos(heading) * place,
                    heading + math.radians(turn),
                )
                components = found.described(centering.apply(extract(ROOM.look(pose), COLOR)))
                cosines = found.cosines(
                    components, np.array(key), np.arange(3)[:, None], np.arange(TURNS_DEG.size)
                )
                best = np.unravel_index(cosines.argmax(), cosines.shape)
                assert best[0] == column
                assert abs(TURNS_DEG[best[1]] - turn) <= 5.0


def test_right_place_is_among_the_candidates_of_a_long_way() -> None:
    found, centering = usual_map()
    count = len(found.keyframes)
    one = drive()
    found = replace(found, config=replace(found.config, looked_at=20))
    for frame in range(0, len(one.poses), 7):
        components = found.described(centering.apply(extract(ROOM.look(one.poses[frame]), COLOR)))
        keyframes, stand_for = found.likely(components)
        assert len(set(keyframes.tolist())) == len(keyframes)
        # The others are stood for by the sample of elsewhere: no place counts more or less than before.
        assert stand_for.sum() == pytest.approx(count)
        assert np.abs(found.keyframes[keyframes[:20]] - frame).min() <= 2


def test_correlation_length_does_not_depend_on_drive_length() -> None:
    usual = usual_map()[0].correlation_length
    closely = replace(CALIBRATION_CONFIG, most_frames=64, reach=1.0)
    with patch("smal.teaching.mapping.TaughtFrames", partial(TaughtFrames, config=closely)):
        found = taught(ROOM, drive(), scene=SCENE)[0]
    assert found.correlation_length == pytest.approx(usual, rel=0.25)


def length_of(way: np.ndarray, views: np.ndarray) -> float:
    """Return the correlation length of features (f, m) along a straight way (f,)."""
    frames = TaughtFrames(
        images=[ROOM.look(drive().poses[0])] * len(way),
        centred=lambda some: unit(views[list(some)]),
        poses=np.stack([way, np.zeros_like(way), np.zeros_like(way)], axis=1),
        drives=np.zeros(len(way), dtype=np.int32),
        describe=lambda _: np.empty((0, 1024), dtype=np.float32),
        movements=np.zeros((5, 2)),
    )
    return correlation_length(frames, Camera.of_field(70.0))[0]


def test_hidden_view_does_not_shorten_the_correlation_length() -> None:
    rng = np.random.default_rng(0)
    way = np.sort(np.append(np.arange(0.0, 80.0), 40.25))
    views = [unit(rng.standard_normal(1024).astype(np.float32))]
    for step in np.diff(way):
        kept = 0.5 ** (step / 3.0)
        views.append(
            kept * views[-1]
            + math.sqrt(1.0 - kept**2) * unit(rng.standard_normal(1024).astype(np.float32))
        )
    views[41] = unit(rng.standard_normal(1024).astype(np.float32))
    assert length_of(way, np.stack(views)) == pytest.approx(3.0, rel=0.25)


def test_drive_is_refused_when_its_views_are_too_far_apart() -> None:
    rng = np.random.default_rng(0)
    way = np.repeat(np.arange(0.0, 40.0), 3)
    views = unit(rng.standard_normal((len(way), 1024)).astype(np.float32))
    with pytest.raises(ValueError, match="images are 1 m apart, but nothing stays alike"):
        length_of(way, views)


class Reader(Sequence[Image]):
    """Images of a drive, which are drawn when they are asked for; counts who asks, and what is still held."""

    def __init__(self, poses: np.ndarray) -> None:
        self._poses = poses
        self._lock = threading.Lock()
        self.reads: Counter[int] = Counter()
        self.held = self.most_held = 0

    def __len__(self) -> int:
        return len(self._poses)

    def __getitem__(self, index: Any) -> Any:
        assert isinstance(index, int)
        image = ROOM.look(self._poses[index])
        with self._lock:
            self.reads[index] += 1
            self.held += 1
            self.most_held = max(self.held, self.most_held)
        weakref.finalize(image, self._release)
        return image

    def _release(self) -> None:
        with self._lock:
            self.held -= 1


def test_images_are_read_when_needed_and_released() -> None:
    starts = (START, ((3.0, 60.0),)), ((2.5, 4.5, 0.0), ((1.0, 0.0),))
    drives = [drive(*one, rate_hz=40.0) for one in starts]
    raw = [np.stack([extract(ROOM.look(pose), COLOR) for pose in one.poses]) for one in drives]
    readers = [Reader(one.poses) for one in drives]
    done: list[tuple[str, int, int]] = []
    found = mapping.learn(
        [
            Demonstration(f"drive-{k}", raw[k], one.atoms, images=readers[k], odometry=one.poses)
            for k, one in enumerate(drives)
        ],
        COLOR,
        0.025,
        lambda *progress: done.append(progress),
        config=MapConfig(sampled_views=500),
    ).mapped
    frames = sum(len(one.poses) for one in drives)
    reads = sum(sum(one.reads.values()) for one in readers)
    # Forty pairs for each of three fits, and keyframes for the components, their views, and mirrored.
    assert reads <= 3 * 2 * 40 + 3 * len(found.keyframes) + 2
    assert sum(len(one.reads) for one in readers) < 0.75 * frames
    assert max(one.most_held for one in readers) < frames / 4
    # Every keyframe is read from the drive that it is of.
    for number, reader in enumerate(readers):
        start = int(np.searchsorted(found.drives, number))
        assert {
            int(key) - start for key in found.keyframes[found.drives[found.keyframes] == number]
        } <= set(reader.reads)
    stages = {"frames": frames, "views": len(found.keyframes)}
    assert done == [
        (stage, number, total) for stage, total in stages.items() for number in range(1, total + 1)
    ]


@pytest.mark.parametrize("odometry", [True, False])
def test_drive_is_refused_when_the_robot_never_moves(odometry: bool) -> None:
    images = [ROOM.look(START)] * 12
    with pytest.raises(ValueError, match="does not move") as refused:
        learn(
            [images], [np.tile(START, (12, 1)) if odometry else None], [np.zeros(12, dtype=np.int8)]
        )
    assert "\n" not in str(refused.value)


def test_drive_is_left_out_when_the_robot_stands_in_it() -> None:
    one = drive(way=((1.5, 0.0),))
    still = [ROOM.look(START)] * 5
    views = [ROOM.look(pose) for pose in one.poses]
    poses = [one.poses, np.tile(START, (5, 1))]
    with pytest.warns(UserWarning, match="drive-1 does not teach: the robot hardly moves"):
        found = learn([views, still], poses, [one.atoms, np.zeros(5, dtype=np.int8)])
    assert found.frames.tolist() == [len(views)]
    assert found.names == (("drive-0",),)


def test_drive_is_refused_when_its_images_are_all_alike() -> None:
    one = drive(way=((1.0, 0.0),))
    blank = [np.full((72, 96, 3), 40, dtype=np.uint8)] * len(one.poses)
    with pytest.raises(ValueError, match="all images of drive-0 look the same"):
        learn([blank], [one.poses], [one.atoms])


@pytest.mark.parametrize("odometry", [True, False])
def test_drive_is_named_when_its_frames_are_too_far_apart(odometry: bool) -> None:
    rng = np.random.default_rng(0)
    noise = [rng.integers(0, 255, (72, 96, 3), dtype=np.uint8) for _ in range(30)]
    # Each place has three images, and none of them is like another.
    way = np.column_stack([1.5 * (np.arange(30) // 3), np.zeros((30, 2))])
    atoms = np.where(np.arange(30) % 3 == 2, 1, 0).astype(np.int8)
    unit = "1.5 m" if odometry else "1 forward actions"
    with pytest.raises(
        ValueError,
        match=f"drive-0: successive images are {unit} apart, but nothing stays alike over .*; drive "
        "more slowly or record more images a second",
    ):
        learn([noise], [way if odometry else None], [atoms])


def test_drive_is_named_when_no_two_views_have_one_heading() -> None:
    ahead = np.arange(0.0, 3.0, 0.02)
    turned = np.column_stack([START[0] + ahead, np.full_like(ahead, START[1]), 60.0 * ahead])
    views = [ROOM.look(pose) for pose in turned]
    with pytest.raises(ValueError, match=r"turns all the time in drive-0: .* drive a straight"):
        learn([views], [turned], [np.ones(len(ahead), dtype=np.int8)])


def test_map_is_the_same_when_it_is_made_from_its_content() -> None:
    good = usual_map()[0]
    numbers, arrays = good.content()
    again = VisualMap.of_content(json.loads(json.dumps(numbers)), arrays)
    assert not {*numbers} & {*arrays}
    assert again.content()[0] == numbers
    for name, array in arrays.items():
        np.testing.assert_array_equal(getattr(again, name), array)


@pytest.mark.parametrize(
    ("name", "harm", "named"),
    [
        ("basis", lambda basis: 1e30 * basis, "components"),
        ("basis", lambda basis: basis[:, :0], "components"),
        ("keyframes", lambda keys: np.append(keys[:-1], -1), "keyframes"),
        ("keyframes", lambda keys: np.append(keys[:-1], np.int32(2**31 - 1)), "keyframes"),
        ("movements", lambda movements: 1e300 * movements, "movements"),
        ("basis", lambda basis: np.zeros((0, 10**6), basis.dtype), "components"),
        ("gamma", lambda _: -1.0, "gamma"),
        ("blank", lambda blank: blank[1:], "blank"),
        ("log_ratio", lambda ratio: ratio[1:], "log_ratio"),
        ("log_ratio", lambda ratio: np.full_like(ratio, np.nan), "log_ratio"),
        ("drives", lambda drives: np.append(drives[:-1], np.int32(2)), "drives"),
        ("goals", lambda _: ("",), "goals"),
        ("goals", lambda _: ("a\x1b[2J",), "goals"),
        ("goals", lambda _: ("x" * 65,), "goals"),
        ("goals", lambda _: ("victim", "victim"), "goals"),
        ("stitched", lambda _: np.array([[0, 10**6]], dtype=np.int32), "stitched"),
        ("stitched", lambda _: np.array([[0, 1], [0, 1]], dtype=np.int32), "stitched"),
        ("variants", lambda _: np.array([10**6], dtype=np.int32), "variants"),
        ("variants", lambda _: np.zeros(4, dtype=np.int32), "variants"),
    ],
)
def test_map_is_refused_when_its_parts_do_not_fit(
    name: str, harm: Callable[[Any], Any], named: str
) -> None:
    found = usual_map()[0]
    with pytest.raises(ValueError, match=f"do not fit together: .*{named}"):
        replace(found, **{name: harm(getattr(found, name))})


def test_map_is_the_same_when_another_executor_learns_it(tmp_path: Path) -> None:
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        mapping.fit([corridor.drive()], corridor.FEATURES, parallel=pool.map).save(
            tmp_path / "there"
        )
    corridor.save_model(tmp_path / "here")
    assert (tmp_path / "there").read_bytes() == (tmp_path / "here").read_bytes()

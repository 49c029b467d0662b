"""The target at the end of a drive: present, absent, or replaced by something else."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest

from smal import Model, Robot
from smal.camera import Image
from smal.features.resizing import SHAPE
from smal.files.container import ModelError
from smal.planning.config import PLANNER_CONFIG
from smal.target.appearance import TargetAppearance, lower_quantile
from smal.target.detector import TargetDetector
from smal.target.learning import Taught, learn_appearance
from tests.corridor import model, moved
from tests.corridor import view as corridor

# Views of the drive, and how many of them a second.
STEPS = 80
SPEED = 2.5
ORANGE = (230, 110, 30)
BLUE = (40, 70, 150)
GREY = (120, 130, 110)


@cache
def scenery() -> Image:
    """Return grey-green land that the way leads along, wide enough for all of it."""
    coarse = np.random.default_rng(3).integers(60, 180, (12, 60, 1)) + np.array([0, 10, -20])
    return cv2.resize(
        np.clip(coarse, 0, 255).astype(np.uint8), (640, 60), interpolation=cv2.INTER_LINEAR
    )


def view(step: float, *colours: tuple[int, int, int], aside: int = 0) -> Image:
    """Return what is seen after so many steps, with a thing of these colours at the end of the way."""
    picture = scenery()[:, round(6 * step) : round(6 * step) + SHAPE[1]].copy()
    size = round(14 * 8 / (STEPS + 7 - step)) if step > STEPS - 16 else 0
    for number, colour in enumerate(colours):
        left = SHAPE[1] // 2 + aside + (number - 1) * size
        picture[40 : 40 + size, left : left + size] = colour
    return picture


def taught(*colours: tuple[int, int, int]) -> Taught:
    left_s = (STEPS - 1 - np.arange(STEPS)) / SPEED
    return Taught([view(step, *colours) for step in range(STEPS)], left_s, ends=True)


@cache
def appearance() -> TargetAppearance:
    learned = learn_appearance([taught(ORANGE, BLUE)])
    assert learned is not None
    return learned


@pytest.mark.parametrize(("step", "aside"), [(STEPS - 1.4, 0), (STEPS - 2.6, 6), (STEPS - 0.8, -9)])
def test_target_is_seen_from_new_places_and_missed_when_absent(step: float, aside: int) -> None:
    assert (
        TargetDetector(appearance()).observe(view(step, ORANGE, BLUE, aside=aside)).probability
        > 0.99
    )
    assert TargetDetector(appearance()).observe(view(step)).probability < 0.1
    assert (
        TargetDetector(appearance())
        .observe(view(step, GREY, (200, 40, 160), aside=aside))
        .probability
        < 0.5
    )


def test_target_is_the_boxed_thing_alone() -> None:
    # Size of each square in the last view; the blue one stands to the right of the middle.
    size = 14
    box = 40 / SHAPE[1], 40 / SHAPE[0], (40 + size) / SHAPE[1], (40 + size) / SHAPE[0]
    learned = learn_appearance([replace(taught(ORANGE, BLUE), box=box)])
    assert learned is not None
    for colours, seen in (((ORANGE, BLUE), True), ((GREY, BLUE), True), ((ORANGE, GREY), False)):
        assert (
            TargetDetector(learned).observe(view(STEPS - 1.4, *colours)).probability > 0.99
        ) == seen
    assert (
        TargetDetector(appearance()).observe(view(STEPS - 1.4, ORANGE, GREY)).probability > 0.99
    ), "both are, without a box"


def test_target_is_not_seen_on_the_way() -> None:
    seen = [TargetDetector(appearance()).observe(view(step + 0.5)) for step in range(STEPS - 20)]
    assert max(one.probability for one in seen) < 0.5
    assert max(one.near for one in seen) < 0.5


def test_it_is_seen_in_half_the_light() -> None:
    assert (
        TargetDetector(appearance()).observe(view(STEPS - 1.4, ORANGE, BLUE) // 2).probability
        > 0.99
    )


def test_target_is_near_when_it_is_as_large_as_taught() -> None:
    near = [
        TargetDetector(appearance())
        .observe(view(step, ORANGE, BLUE), place=((STEPS - step) / SPEED, 0.1))
        .near
        for step in (STEPS - 13, STEPS - 5, STEPS - 1.4)
    ]
    assert near == sorted(near)
    assert near[1] < 0.75
    assert near[2] > 0.9


def test_target_is_near_at_the_end_when_the_border_cuts_it() -> None:
    """The thing lies on the ground, so that it leaves the view at the bottom."""
    colours = np.random.default_rng(1).integers(0, 255, (4, 8, 3), dtype=np.uint8)
    last = STEPS + 3

    def lying(step: float) -> Image:
        picture = view(step)
        size = round(14 * 8 / (STEPS + 7 - step)) if step > STEPS - 16 else 0
        top = round(30 + 0.7 * size)
        thing = cv2.resize(colours, (2 * max(size, 1), max(size, 1)))[: min(size, SHAPE[0] - top)]
        left = SHAPE[1] // 2 - size
        picture[top : top + len(thing), left : left + 2 * size] = thing[:, : 2 * size]
        return picture

    left_s = (last - np.arange(last + 1)) / SPEED
    learned = learn_appearance(
        [Taught([lying(step) for step in range(last + 1)], left_s, ends=True)]
    )
    assert learned is not None
    for step in (last - 0.4, last + 0.2):
        place = ((last - step) / SPEED, 0.1)
        estimate = TargetDetector(learned).observe(lying(step), place=place)
        assert estimate.probability > PLANNER_CONFIG.in_view
        assert estimate.near == pytest.approx(4 / (STEPS + 7 - step), abs=0.08)


@pytest.mark.parametrize("gain", [0.35, 0.7, 1.6])
def test_target_is_found_near_when_the_light_differs(gain: float) -> None:
    light = np.clip(gain * view(STEPS - 1.4, ORANGE, BLUE).astype(float), 0, 255).astype(np.uint8)
    estimate = TargetDetector(appearance()).observe(light)
    assert estimate.probability > PLANNER_CONFIG.in_view
    assert estimate.near == pytest.approx(1.0, abs=0.2)


def test_noise_is_no_evidence_when_all_is_unlike() -> None:
    rng = np.random.default_rng(0)
    views = (view(step) // 8 + rng.integers(0, 24, (*SHAPE, 3)) for step in range(0, STEPS, 4))
    seen = [
        TargetDetector(appearance()).observe(each.astype(np.uint8)).probability for each in views
    ]
    assert max(seen) < 0.5


def test_place_corrects_the_distance_when_the_target_is_small() -> None:
    far = view(STEPS - 6, ORANGE, BLUE)
    by_view, at_end, before = (
        TargetDetector(appearance()).observe(far, place=place).near
        for place in (None, (0.0, 0.1), (9.0, 0.1))
    )
    assert before < by_view < at_end < 1.0


def test_a_hidden_view_is_no_evidence() -> None:
    detector = TargetDetector(appearance())
    hidden = np.full((*SHAPE, 3), 30, np.uint8)
    assert detector.observe(hidden).probability == 0.5
    found = detector.observe(view(STEPS - 1.4, ORANGE, BLUE)).probability
    assert detector.observe(hidden).probability == found > 0.99


def test_no_target_is_learned_when_nothing_stands_out() -> None:
    round_again = [view(step % 40) for step in range(STEPS)]
    assert learn_appearance([Taught(round_again, taught().left_s, ends=True)]) is None
    assert learn_appearance([Taught([view(0)] * 3, np.arange(3.0)[::-1], ends=True)]) is None


def test_parts_that_do_not_fit_are_refused_by_name() -> None:
    with pytest.raises(ValueError, match="do not fit together: windows"):
        replace(appearance(), windows=np.array([[0, 99]], np.int32))


def test_robot_reports_not_here_when_its_target_is_missing(tmp_path: Path) -> None:
    for appearances, said in (({}, "found"), ({"victim": appearance()}, "not_here")):
        replace(model(), appearances=appearances).save(tmp_path / "way.smal")
        robot = Robot(Model.load(tmp_path / "way.smal"))
        here = (2.4, 0.1, 0.05)
        for _ in range(250):
            here = moved(here, robot.step(corridor(*here), here))
            if robot.done:
                break
        assert robot.said == said


@pytest.mark.parametrize("name", ["end_s", "size", "power", "size_error", "low_error"])
def test_distance_is_rejected_when_a_number_is_negative(name: str) -> None:
    distance = appearance().distance
    assert replace(distance, low=-distance.low) != distance
    with pytest.raises(ValueError, match="do not fit together: distance"):
        replace(distance, **{name: -1.0})


def test_quantile_is_infinite_when_nothing_else_was_taught() -> None:
    distances = np.array([np.inf, 1.0, np.inf, np.inf])
    assert lower_quantile(distances, 0.5) == np.inf
    assert lower_quantile(distances, 0.1) == 1.0


def test_file_is_refused_when_its_target_does_not_fit(tmp_path: Path) -> None:
    harmed = replace(model(), appearances={"victim": appearance()})
    vars(harmed.appearances["victim"])["unlike"] = -1.0
    try:
        harmed.save(tmp_path / "way.smal")
    finally:
        appearance.cache_clear()
    with pytest.raises(ModelError, match="the target do not fit together: unlike"):
        Model.load(tmp_path / "way.smal")

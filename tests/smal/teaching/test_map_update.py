"""A map that learns from runs on other days, and keeps what was taught."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from smal.features import extract
from smal.filter import Filter
from smal.map import VisualMap
from smal.model import Model
from smal.teaching import map_update
from smal.teaching.demonstration import Demonstration, whole_drives
from smal.teaching.map_update import compared, update_map, with_view_variants
from tests.smal.synthetic_world import CAMERA, COLOR, START, Drive, Image, Room, drive, usual_map

#: Localising a run takes most of the time, and always gives the same.
localised = cache(map_update.localise)


@pytest.fixture(autouse=True)
def localised_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(map_update, "localise", localised)


@cache
def model() -> Model:
    mapped, centering = usual_map()
    return Model(centering, mapped)


def look(pose: NDArray[np.float64], paint: int, new: float) -> Image:
    """Return what a camera sees on a day on which so much of the room's paint is another one."""
    old = Room().look(pose).astype(np.float32)
    other = Room(paint).look(pose)
    return np.asarray(np.rint((1.0 - new) * old + new * other), dtype=np.uint8)


@cache
def run(paint: int, new: float, aside: float = 0.05) -> Demonstration:
    """Drive the taught way a little beside it, on another day."""
    way: Drive = drive((START[0], START[1] + aside, START[2]), speed=2.0)
    images = [look(pose, paint, new) for pose in way.poses]
    return Demonstration(
        f"run-{paint}-{new}-{aside}",
        np.stack([extract(image, COLOR) for image in images]),
        way.atoms,
        images=images,
        odometry=way.poses,
        camera=CAMERA,
    )


def variants_of(mapped: VisualMap) -> int:
    return int(np.bincount(mapped.variants, minlength=1).max())


@pytest.mark.long
def test_changed_places_get_a_variant_that_fits_the_day() -> None:
    grown = with_view_variants(model(), [run(7, 0.5)])
    taught = model().mapped
    count = len(taught.keyframes)
    assert 0 < len(grown.mapped.variants) <= count
    assert variants_of(grown.mapped) == 1
    np.testing.assert_array_equal(grown.mapped.views[:count], taught.views)
    that_day = [run(7, 0.5, aside) for aside in (-0.05, 0.1)]
    verdict = compared(model(), grown, that_day)
    assert verdict.gain > 0.015
    assert verdict.better
    assert not compared(grown, model(), that_day).better
    assert compared(model(), grown, [run(0, 0.0)]).better


def test_taught_day_teaches_nothing_new() -> None:
    assert with_view_variants(model(), [run(0, 0.0)]) is model()
    unchanged, verdict = update_map(model(), [run(0, 0.0), run(0, 0.0, -0.05)])
    assert unchanged is model()
    assert not verdict.better


def test_second_half_of_the_runs_decides() -> None:
    better, verdict = update_map(model(), [run(7, 0.5, aside) for aside in (0.05, -0.05, 0.1, 0.0)])
    assert verdict.better
    assert len(better.mapped.variants) > 0
    with pytest.raises(ValueError, match="too few runs"):
        update_map(model(), [run(7, 0.5)])


def test_variants_are_bounded_and_keep_the_taught_one() -> None:
    taught = model().mapped
    taught = replace(taught, config=replace(taught.config, most_variants=2))
    once = with_view_variants(Model(model().centering, taught), [run(7, 0.6)]).mapped
    twice = with_view_variants(Model(model().centering, once), [run(8, 0.6)]).mapped
    assert variants_of(twice) == 1
    assert len(twice.variants) >= len(once.variants)
    np.testing.assert_array_equal(twice.views[: len(taught.keyframes)], taught.views)
    # What explains nothing of that day goes: at least one place looks like it now.
    rows = len(taught.keyframes)
    assert not np.isin(
        twice.views[rows:].sum(axis=(1, 2, 3)), once.views[rows:].sum(axis=(1, 2, 3))
    ).all()


def test_failed_run_or_run_without_images_teaches_nothing() -> None:
    (failed,) = whole_drives([replace(run(7, 0.6), successful=False)])
    assert failed.unfit == "it does not end at the goal"
    assert with_view_variants(model(), [replace(run(7, 0.6), camera=None)]) is model()


def test_belief_is_unchanged_when_a_view_variant_is_a_copy() -> None:
    taught = model().mapped
    keys = np.arange(0, len(taught.keyframes), 3, dtype=np.int32)
    twice = replace(taught, views=np.concatenate([taught.views, taught.views[keys]]), variants=keys)
    one = Filter(taught, model().centering)
    other = Filter(twice, model().centering)
    for raw in run(0, 0.0).features[:20]:
        before = one.observe(raw)
        after = other.observe(raw)
        np.testing.assert_allclose(after.weights, before.weights, atol=1e-9)
        assert after.evidence == pytest.approx(before.evidence, abs=1e-6)


def test_variants_lead_to_their_keyframes_on_a_long_way() -> None:
    taught = model().mapped
    middle = taught.config.views_a_length // 2
    keys = np.arange(middle, len(taught.keyframes), taught.config.views_a_length, dtype=np.int32)
    # The variant of each place is the taught view of the next place.
    twice = replace(
        taught,
        views=np.concatenate([taught.views, taught.views[np.roll(keys, -1)]]),
        variants=keys,
        config=replace(taught.config, looked_at=taught.config.views_a_length),
    )
    view = twice.sample[0] * 0.0 + np.asarray(twice.views[keys[1], 1, 8], dtype=np.float32)
    found = {int(one) for one in twice.likely(view / np.linalg.norm(view))[0]}
    assert {int(keys[0]), int(keys[1])} & found

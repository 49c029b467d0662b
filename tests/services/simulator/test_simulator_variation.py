"""Variations: each changes what it says and nothing else, and the way to the victim stays free."""

from __future__ import annotations

import math

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from services.simulator.scene.atmosphere import exposed, hazy
from services.simulator.variation import DAY, VARIATIONS
from services.simulator.world import load_world
from services.simulator.world.collision import obstacles_of
from services.simulator.world.room_file import sights
from services.simulator.world.route import plan_route
from services.simulator.world.varying import vary

WORLDS = {name: load_world(name) for name in ("campus", "yard")}
INDOOR = load_world("indoor")
seeds = st.integers(1, 10_000)
images = arrays.arrays(np.uint8, (6, 5, 3))


@given(name=st.sampled_from(sorted(WORLDS)), seed=seeds)
@settings(max_examples=25, deadline=None)
def test_moved_things_leave_the_way_free(name: str, seed: int) -> None:
    world = WORLDS[name]
    moved = vary(world, clutter_seed=seed)
    route = plan_route(world, (world.start.x, world.start.y))
    legs = np.stack([route[:-1], route[1:]], axis=1)
    assert obstacles_of(moved.place).are_clear(legs, world.robot.radius_m).all()
    assert (moved.start, moved.victim, moved.place.roads) == (world.start, world.victim, world.place.roads)  # type: ignore[attr-defined]
    pairs = list(zip(world.place.trees, moved.place.trees, strict=True))  # type: ignore[attr-defined]
    away = np.array([np.hypot(one.x - other.x, one.y - other.y) for one, other in pairs])
    assert away.max() <= 3 * np.sqrt(2)
    assert (away > 0.1).mean() > 0.5, "most of them do move"
    solid = shapely.union_all([building.footprint for building in world.place.buildings])  # type: ignore[attr-defined]
    for (_, tree), way in zip(pairs, away, strict=True):
        assert way == 0 or shapely.Point(tree.x, tree.y).distance(solid) > tree.trunk_radius_m * 0.99


@given(name=st.sampled_from(sorted(WORLDS)), seed=seeds)
@settings(max_examples=15, deadline=None)
def test_repainting_keeps_what_is_alike_alike(name: str, seed: int) -> None:
    before, after = (world.place.buildings for world in (WORLDS[name], vary(WORLDS[name], facade_seed=seed)))  # type: ignore[attr-defined]
    assert all(one.facade != other.facade for one, other in zip(before, after, strict=True))
    assert len({b.facade for b in before}) == len({b.facade for b in after})
    assert [b.footprint for b in before] == [b.footprint for b in after]


@given(seed=seeds)
@settings(max_examples=15, deadline=None)
def test_furniture_that_was_pushed_about_stands_in_the_room_and_in_nothing_else(seed: int) -> None:
    before, after = INDOOR, vary(INDOOR, clutter_seed=seed)
    route = plan_route(before, (before.start.x, before.start.y))
    legs = np.stack([route[:-1], route[1:]], axis=1)
    assert obstacles_of(after.place).are_clear(legs, before.scale.clearance_m).all()
    pieces = after.place.furniture  # type: ignore[attr-defined]
    area = shapely.union_all([piece.footprint for piece in pieces]).area
    assert area == pytest.approx(sum(piece.footprint.area for piece in pieces))
    assert all(shapely.box(*after.place.bounds).buffer(1e-6).covers(piece.footprint) for piece in pieces)
    pairs = list(zip(before.place.furniture, pieces, strict=True))  # type: ignore[attr-defined]
    assert sum(one != other for one, other in pairs) >= 3
    assert all(math.hypot(one.x - other.x, one.y - other.y) <= 0.3 * math.sqrt(2) for one, other in pairs)
    assert not obstacles_of(after.place).in_sight(sights(after)).any(), "the victim stays hidden"


def test_other_posters_hang_at_the_same_places() -> None:
    before, after = (world.place.fittings for world in (INDOOR, vary(INDOOR, facade_seed=1)))  # type: ignore[attr-defined]
    for one, other in zip(before, after, strict=True):
        assert (one.kind, one.wall, one.along_m) == (other.kind, other.wall, other.along_m)
        assert one.variant != other.variant
    alike = [{(one.kind, one.variant) for one in fittings} for fittings in (before, after)]
    assert len(alike[0]) == len(alike[1])


def test_no_seed_changes_nothing() -> None:
    assert vary(WORLDS["campus"]).place is WORLDS["campus"].place
    one, again = (vary(WORLDS["campus"], facade_seed=3, clutter_seed=4).place for _ in range(2))
    assert (one.trees, one.buildings[0].facade) == (again.trees, again.buildings[0].facade)  # type: ignore[attr-defined]


@given(image=images, distance=st.floats(0.1, 500), visibility=st.floats(5, 5000))
def test_haze_takes_contrast_as_koschmieder_says(
    image: np.ndarray[tuple[int, ...], np.dtype[np.uint8]], distance: float, visibility: float
) -> None:
    depth = np.full(image.shape[:2], distance, dtype=np.float32)
    seen = hazy(image, depth, visibility, (200.0, 210.0, 220.0)).astype(float)
    left = 0.05 ** (distance / visibility)
    np.testing.assert_allclose(seen, image * left + np.array([200, 210, 220]) * (1 - left), atol=0.51)


def test_the_sky_is_hazy_through_and_through() -> None:
    image = np.zeros((2, 2, 3), dtype=np.uint8)
    sky = np.full((2, 2), np.inf, dtype=np.float32)
    assert (hazy(image, sky, 60.0, (200.0, 201.0, 202.0)) == (200, 201, 202)).all()


@given(image=images, stops=st.floats(-4, 4))
def test_exposure_keeps_the_order_of_grey_values(
    image: np.ndarray[tuple[int, ...], np.dtype[np.uint8]], stops: float
) -> None:
    seen = exposed(image, stops)
    order = np.argsort(image, axis=None)
    assert (np.diff(seen.ravel()[order].astype(int)) >= 0).all()
    assert (seen >= image).all() if stops >= 0 else (seen <= image).all()


def test_one_stop_is_twice_the_light() -> None:
    # sRGB 118 is 18.1 % of white in linear light, sRGB 161 is 35.6 %: standard grey cards.
    assert exposed(np.full((1, 1, 3), 118, dtype=np.uint8), 1.0)[0, 0, 0] == pytest.approx(162, abs=1)
    np.testing.assert_array_equal(exposed(np.arange(256, dtype=np.uint8)[None, :, None], 0.0).ravel(), np.arange(256))


def test_every_variation_has_a_name_and_differs_from_day() -> None:
    assert VARIATIONS["day"] is DAY
    for name, one in VARIATIONS.items():
        assert one.name == name
        assert name == "day" or any(
            getattr(one, field) != getattr(DAY, field)
            for field in ("light", "visibility_m", "exposure_ev", "facade_seed", "clutter_seed")
        )
        assert np.linalg.norm(one.light.direction) == pytest.approx(1.0)
        assert one.light.direction[2] < 0, "sunlight goes down"
